"""Whether LiDAR and images agree: a wrong camera pose, lens, image or time makes their edges disagree."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from genre_tasks.log_checks.edge_agreement import (
    STRIPS,
    Agreement,
    AngularGrid,
    correlate_edges,
    find_image_edges,
    find_range_edges,
    score_turns,
)
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Camera, Float32, Float64, Lens

# Images of a camera that are compared, spread over the chunk. Scores grow with the root of their number, so that a
# camera with a low one is compared again by more of them.
_IMAGES = 3
_MORE_IMAGES = 8
_PIXELS_PER_DEG = 4.0
_WIDTH_RANGE_PX = (160, 400)
# Coarser images have no edges of their own at the scale of the grid.
_MIN_PIXELS_PER_DEG = 2.0
_MIN_GRID = (40, 60)
# LiDAR edges of an image on average: fewer give no verdict.
_MIN_EDGES = 100
# From the synthetic streets 900 to 939, chunk 0 of the real sequence and KITTI: see the benchmark ``log_faults``.
_MIN_SCORE = 5.0
_MIN_MARGIN = 2.0
_CHANCE_SCORE = 2.5
# Spread of the contrast of an image's edges: in the dark there is noise in place of edges.
_MIN_CONTRAST = 0.5
# Focal lengths and rolls that are tried where an image does not fit.
_FOCAL_FACTORS = (0.5, 0.6, 0.7, 0.77, 0.83, 0.91, 1.1, 1.2, 1.3, 1.43, 1.67, 2.0)
_ROLLS_DEG = (-10.0, -5.0, 5.0, 10.0)
# Cameras whose cause is searched for by all means: where more are wrong, they mostly have one cause.
_EXPLAINED_CAMERAS = 2
# Frames to either side whose images are tried, where those of the frame itself do not fit.
_FRAME_OFFSETS = (-2, -1, 1, 2)
_POSE_REMEDY = "Check the camera's extrinsic calibration, and that poses are those of the image's own time."
_LENS_REMEDY = "Check fx and fy, and that they belong to images of this size."
_IMAGE_REMEDY = "Check that the images of the folder are of this camera, unturned, with the numbers of their frames."

Edit = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
_FLIPS: dict[str, Edit] = {
    "mirrored": lambda pixels: pixels[:, ::-1],
    "turned by 180°": lambda pixels: pixels[::-1, ::-1],
    "upside down": lambda pixels: pixels[::-1],
}


@dataclass(frozen=True)
class CameraView:
    """What is compared for one camera.

    Attributes:
        camera: the camera.
        lens: of the images at the size at which they are compared.
        grid: of its directions.
        points: by frame, [N, 3] metres in camera axes.
        image_edges: by frame, [H, W].
    """

    camera: Camera
    lens: Lens
    grid: AngularGrid
    points: dict[int, Float64]
    image_edges: dict[int, Float32]

    @cached_property
    def range_edges(self) -> dict[int, Float32]:
        """By frame, [H, W]."""
        return {frame: find_range_edges(points, self.grid) for frame, points in self.points.items()}

    @property
    def few_frames(self) -> tuple[int, ...]:
        """Some of the frames, for what is tried many times."""
        frames = tuple(self.points)
        return frames[:: max(1, round(len(frames) / _IMAGES))]

    @property
    def has_edges(self) -> bool:
        """Whether there is enough to compare."""
        if not self.points:
            return False
        counts = [(edges > 1).sum() for edges in self.range_edges.values()]
        contrast = [edges[edges != 0].std() for edges in self.image_edges.values() if edges.any()]
        # Half of the images may well be of a wall.
        return bool(np.mean(counts) >= _MIN_EDGES and contrast and np.median(contrast) >= _MIN_CONTRAST)


def find_miscalibration(sample: LogSample) -> Iterator[Finding]:
    """Finds cameras whose images do not show what the LiDAR measures.

    Args:
        sample: the frames of a chunk.

    Yields:
        For each camera at most one of ``turned_camera``, ``odd_field_of_view``, ``rolled_camera``, ``flipped_images``,
        ``images_of_another_camera``, ``images_of_another_frame`` and ``lidar_image_mismatch``. Images or sweeps
        without enough edges give no verdict.
    """
    found = 0
    for camera in sample.cameras:
        agreement = measure_agreement(sample, camera)
        if agreement is None or _is_sound(agreement):
            continue
        finding = _explain(sample, camera, in_full=found < _EXPLAINED_CAMERAS)
        if finding is not None:
            found += 1
            yield finding


def measure_agreement(sample: LogSample, camera: Camera, images: int = _IMAGES) -> Agreement | None:
    """Measures how well the edges of a camera's images agree with those of the LiDAR.

    Args:
        sample: the frames of a chunk.
        camera: one of its cameras.
        images: how many are compared at most.

    Returns:
        The scores; ``None`` where images or sweeps do not have enough edges.
    """
    view = _view_camera(sample, camera, images)
    return None if view is None else _score(view.range_edges, view.image_edges)


def _is_sound(agreement: Agreement) -> bool:
    others = max(agreement.best, agreement.best_stretch)
    return agreement.score >= _MIN_SCORE and others < agreement.score + _MIN_MARGIN


def _view_camera(sample: LogSample, camera: Camera, images: int) -> CameraView | None:
    """The edges of a camera's images and the points that they show; ``None`` where there are too few."""
    lens = camera.lens
    field_deg = np.rad2deg(np.arctan(lens.cx_px / lens.fx_px) + np.arctan((lens.width_px - lens.cx_px) / lens.fx_px))
    if not 0 < field_deg * _MIN_PIXELS_PER_DEG <= lens.width_px:
        return None
    width_px = int(np.clip(field_deg * _PIXELS_PER_DEG, *_WIDTH_RANGE_PX))
    lens = lens.resized_to_width(min(width_px, lens.width_px))
    grid = AngularGrid.of_lens(lens)
    if grid.shape[0] < _MIN_GRID[0] or grid.shape[1] < _MIN_GRID[1]:
        return None
    view = CameraView(camera, lens, grid, {}, {})
    poses = sample.world_SE3_camera(camera)
    for index in np.unique(np.linspace(0, len(sample.frames) - 1, images).round().astype(int)):
        frame = sample.frames[index]
        edges = _read_image_edges(sample, view, camera, frame)
        sweep = sample.sweep(frame)
        if edges is None or sweep is None or not np.isfinite(poses[index]).all():
            continue
        # By einsum: a matrix product would start threads for a matrix of three columns.
        offset = sweep.points_world - poses[index, :3, 3]
        view.points[frame] = np.einsum("ni,ij->nj", offset, poses[index, :3, :3])
        view.image_edges[frame] = edges
    return view if view.has_edges else None


def _read_image_edges(
    sample: LogSample, view: CameraView, camera: Camera, frame: int, edit: Edit | None = None
) -> Float32 | None:
    """Edges of an image as if it were one of the view's camera; ``None`` where it cannot be read."""
    pixels = sample.pixels(camera, frame, view.lens.width_px)
    if pixels is None or pixels.shape[:2] != (view.lens.height_px, view.lens.width_px):
        return None
    return find_image_edges(pixels if edit is None else edit(pixels), view.lens, view.grid)


def _score(range_edges: dict[int, Float32], image_edges: dict[int, Float32]) -> Agreement | None:
    """Agreement of LiDAR edges and images, by frame."""
    surfaces = [correlate_edges(range_edges[frame], edges) for frame, edges in image_edges.items()]
    return score_turns(np.sum(surfaces, axis=0)) if surfaces else None


@dataclass(frozen=True)
class Explanation:
    """A change that may make the edges agree.

    Attributes:
        word: of the finding.
        score: with the change.
        cause: completes "agree better".
        remedy: what the user can do.
        numbers: further numbers of the finding.
    """

    word: str
    score: float
    cause: str
    remedy: str
    numbers: dict[str, float]


def _explain(sample: LogSample, camera: Camera, in_full: bool) -> Finding | None:
    """What makes the edges agree; a finding without a cause where nothing does; ``None`` where nothing can be said."""
    view = _view_camera(sample, camera, _MORE_IMAGES)
    agreement = None if view is None else _score(view.range_edges, view.image_edges)
    if view is None or agreement is None or _is_sound(agreement):
        return None
    name = camera.name
    frames = tuple(view.image_edges)
    numbers = {"score": agreement.score, "min_score": _MIN_SCORE, "min_margin": _MIN_MARGIN}
    explanations = [_explain_by_turn(agreement)]
    if in_full:
        explanations += _explain_by_lens(view, agreement)
        explanations += _explain_by_roll(view, agreement)
        explanations += _explain_by_images(sample, view)
    best = max(explanations, key=lambda explanation: explanation.score)
    if best.score >= max(_MIN_SCORE, agreement.score + _MIN_MARGIN):
        message = (
            f"{name}: edges of LiDAR and images agree poorly ({agreement.score:.1f} standard deviations above "
            f"chance) and better ({best.score:.1f}) {best.cause}"
        )
        numbers |= {"best_score": best.score, **best.numbers}
        return Finding(best.word, "warning", message, best.remedy, numbers, name, frames)
    if agreement.score < _CHANCE_SCORE:
        message = f"{name}: edges of LiDAR and images agree no better than chance ({agreement.score:.1f})"
        remedy = "Check poses, calibration, and that images and sweeps are of the same frames."
        return Finding("lidar_image_mismatch", "warning", message, remedy, numbers, name, frames)
    return None


def _explain_by_turn(agreement: Agreement) -> Explanation:
    """Another pose of the camera. Points that belong further to the right belong to a camera turned to the left."""
    yaw_deg = agreement.yaw_deg
    pitch_deg = agreement.pitch_deg
    cause = f"with the camera turned by {abs(yaw_deg):.1f}° to the {'left' if yaw_deg > 0 else 'right'}"
    cause += f" and {abs(pitch_deg):.1f}° {'up' if pitch_deg > 0 else 'down'}"
    numbers = {"yaw_deg": yaw_deg, "pitch_deg": pitch_deg}
    return Explanation("turned_camera", agreement.best, cause, _POSE_REMEDY, numbers)


def _explain_by_lens(view: CameraView, agreement: Agreement) -> Iterator[Explanation]:
    """Another focal length."""
    # The middle of the outer thirds of the image.
    side = float(np.ptp(view.grid.azimuth_rad)) / STRIPS
    if abs(agreement.stretch_deg) >= abs(agreement.slope_deg):
        factor = float(np.tan(side + np.deg2rad(agreement.stretch_deg)) / np.tan(side))
        yield _explain_by_focal_factor(factor, agreement.best_stretch)
    for factor in _FOCAL_FACTORS:
        yield _explain_by_focal_factor(factor, _score_points(view, np.diag([factor, factor, 1.0])))


def _explain_by_focal_factor(factor: float, score: float) -> Explanation:
    cause = f"with {factor:.2f} times the focal length"
    return Explanation("odd_field_of_view", score, cause, _LENS_REMEDY, {"focal_factor": factor})


def _explain_by_roll(view: CameraView, agreement: Agreement) -> Iterator[Explanation]:
    """A turn about the camera's axis."""
    side = float(np.ptp(view.grid.azimuth_rad)) / STRIPS
    rolls = {roll_deg: _score_points(view, _roll(roll_deg)) for roll_deg in _ROLLS_DEG}
    if abs(agreement.slope_deg) > abs(agreement.stretch_deg):
        rolls[float(np.rad2deg(np.arctan2(np.deg2rad(agreement.slope_deg), side)))] = agreement.best_stretch
    for roll_deg, score in rolls.items():
        cause = f"with the camera rolled by {abs(roll_deg):.0f}°"
        yield Explanation("rolled_camera", score, cause, _POSE_REMEDY, {"roll_deg": roll_deg})


def _roll(roll_deg: float) -> Float64:
    c, s = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _score_points(view: CameraView, matrix: Float64) -> float:
    """Score with the points changed by [3, 3]; of a few images, since many changes are tried."""
    frames = view.few_frames
    range_edges = {
        frame: find_range_edges(np.einsum("ni,ji->nj", view.points[frame], matrix), view.grid) for frame in frames
    }
    agreement = _score(range_edges, {frame: view.image_edges[frame] for frame in frames})
    return -np.inf if agreement is None else agreement.score


def _explain_by_images(sample: LogSample, view: CameraView) -> Iterator[Explanation]:
    """The images flipped, of another camera, or of another frame."""
    camera = view.camera
    frames = view.few_frames
    for name, edit in _FLIPS.items():
        score = _score_images(sample, view, {frame: (camera, frame) for frame in frames}, edit)
        yield Explanation("flipped_images", score, f"with the images {name}", _IMAGE_REMEDY, {})
    for other in sample.cameras:
        if other.name != camera.name:
            score = _score_images(sample, view, {frame: (other, frame) for frame in frames})
            cause = f"with the images of {other.name}"
            yield Explanation("images_of_another_camera", score, cause, _IMAGE_REMEDY, {})
    for offset in _FRAME_OFFSETS:
        sources = {frame: (camera, frame + offset) for frame in frames if frame + offset in sample.frames}
        score = _score_images(sample, view, sources)
        count = f"{abs(offset)} frame{'s' if abs(offset) > 1 else ''}"
        cause = f"with the images {count} {'later' if offset > 0 else 'earlier'}"
        numbers = {"offset_frames": float(offset)}
        yield Explanation("images_of_another_frame", score, cause, _IMAGE_REMEDY, numbers)


def _score_images(
    sample: LogSample, view: CameraView, sources: dict[int, tuple[Camera, int]], edit: Edit | None = None
) -> float:
    """Score of other images, by the frame of the LiDAR edges; minus infinity where they cannot be read."""
    edges = {}
    for frame, (camera, image_frame) in sources.items():
        found = _read_image_edges(sample, view, camera, image_frame, edit)
        if found is not None:
            edges[frame] = found
    agreement = _score(view.range_edges, edges)
    return -np.inf if agreement is None else agreement.score
