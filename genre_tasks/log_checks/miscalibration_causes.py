"""What may make LiDAR and images disagree: each cause is undone, and the edges are compared again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from genre_tasks.log_checks.camera_view import CameraView, Edit, read_image_edges, score_edges
from genre_tasks.log_checks.edge_agreement import STRIPS, Agreement, Turn, find_range_edges
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.types import Camera, Float64, Lens

# Edges of objects that stand in front of others draw a sound camera's images out by a little less.
_MIN_FOCAL_DEVIATION = 0.035
# Focal lengths, sizes of the intrinsics' image, and rolls that are tried.
_FOCAL_FACTORS = (0.5, 0.6, 0.7, 0.77, 0.83, 0.91, 1.1, 1.2, 1.3, 1.43, 1.67, 2.0)
_SIZE_FACTORS = (0.5, 0.667, 0.75, 1.333, 1.5, 2.0)
_ROLLS_DEG = (-10.0, -5.0, 5.0, 10.0)
# Frames to either side whose images are tried.
_FRAME_OFFSETS = (-2, -1, 1, 2)
_POSE_REMEDY = "Check the camera's extrinsic calibration, and that poses are those of the image's own time."
_LENS_REMEDY = "Check fx and fy, and that they belong to images of this size."
_IMAGE_REMEDY = "Check that the images of the folder are of this camera, unturned, with the numbers of their frames."

_FLIPS: dict[str, Edit] = {
    "mirrored (or the points)": lambda pixels: pixels[:, ::-1],
    "turned by 180°": lambda pixels: pixels[::-1, ::-1],
    "upside down (or the points)": lambda pixels: pixels[::-1],
}


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


def list_explanations(sample: LogSample, view: CameraView, agreement: Agreement) -> Iterator[Explanation]:
    """Undoes every cause that is known, one by one.

    Args:
        sample: the frames of a chunk.
        view: of the camera.
        agreement: of its edges as they are.

    Yields:
        Explanations with their scores, good or not.
    """
    yield from _explain_by_lens(view, agreement)
    yield from _explain_by_size(sample, view)
    yield from _explain_by_roll(view, agreement)
    yield from _explain_by_images(sample, view)


def explain_by_turn(turn: Turn) -> Explanation:
    """Explains by another pose of the camera.

    Args:
        turn: of the points; where they belong further to the right, the camera belongs turned to the left.
    """
    cause = f"with the camera turned by {abs(turn.yaw_deg):.1f}° to the {'left' if turn.yaw_deg > 0 else 'right'}"
    cause += f" and {abs(turn.pitch_deg):.1f}° {'up' if turn.pitch_deg > 0 else 'down'}"
    numbers = {"yaw_deg": turn.yaw_deg, "pitch_deg": turn.pitch_deg}
    return Explanation("turned_camera", turn.score, cause, _POSE_REMEDY, numbers)


def _explain_by_lens(view: CameraView, agreement: Agreement) -> Iterator[Explanation]:
    """Another focal length."""
    # The middle of the outer thirds of the image.
    side = float(np.ptp(view.grid.azimuth_rad)) / STRIPS
    if abs(agreement.stretch_deg) >= abs(agreement.slope_deg):
        factor = float(np.tan(side + np.deg2rad(agreement.stretch_deg)) / np.tan(side))
        if abs(factor - 1.0) >= _MIN_FOCAL_DEVIATION:
            yield _explain_by_focal_factor(factor, agreement.best_stretch)
    for factor in _FOCAL_FACTORS:
        yield _explain_by_focal_factor(factor, _score_points(view, np.diag([factor, factor, 1.0])))


def _explain_by_size(sample: LogSample, view: CameraView) -> Iterator[Explanation]:
    """Intrinsics that belong to a larger or smaller image."""
    lens = view.lens
    for factor in _SIZE_FACTORS:
        other = replace(
            lens,
            fx_px=factor * lens.fx_px,
            fy_px=factor * lens.fy_px,
            cx_px=factor * lens.cx_px,
            cy_px=factor * lens.cy_px,
        )
        sources = {frame: (view.camera, frame) for frame in view.few_frames}
        score = _score_images(sample, view, sources, lens=other)
        cause = f"with {factor:.2g} times fx, fy, cx and cy, as for images of another size"
        yield Explanation("intrinsics_of_another_size", score, cause, _LENS_REMEDY, {"size_factor": factor})


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
    agreement = score_edges(range_edges, {frame: view.image_edges[frame] for frame in frames})
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
    sample: LogSample,
    view: CameraView,
    sources: dict[int, tuple[Camera, int]],
    edit: Edit | None = None,
    lens: Lens | None = None,
) -> float:
    """Score of other images, by the frame of the LiDAR edges; minus infinity where they cannot be read."""
    edges = {}
    for frame, (camera, image_frame) in sources.items():
        found = read_image_edges(sample, view, camera, image_frame, edit, lens)
        if found is not None:
            edges[frame] = found
    agreement = score_edges(view.range_edges, edges)
    return -np.inf if agreement is None else agreement.score
