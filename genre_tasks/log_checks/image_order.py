"""Whether a camera's images are in the order of its poses: not reversed, and not some frames early or late.

A sweep that is viewed from the pose of another frame has its edges elsewhere in the image. Where the edges of the
images agree better with the poses of other frames than with their own, the images are those of other frames.
"""

from __future__ import annotations

import numpy as np

from genre_tasks.log_checks.camera_view import FEW_IMAGES, CameraView, score_edges, view_camera
from genre_tasks.log_checks.edge_agreement import find_range_edges
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Camera, Float32, Float64
from genre_tasks.scene.transforms import is_rigid_transform

# Many images are read only where few make another order likely; right orders gain 2 and more by few.
_MANY_IMAGES = 8
_LIKELY_MARGIN = 1.0
# A comparison needs less than a measurement: images of 160 pixels for 92° tell the order.
_MIN_PIXELS_PER_DEG = 1.5
_LIKELY_OFFSETS = (-1, 1)
_OFFSETS = (-2, -1, 1, 2)
# In the real sequence another order scores 1.0 above the log's at most, in sound streets 1.5 below; right ones 3 to 12.
_MIN_SCORE = 5.0
_MIN_MARGIN = 2.5
# With fewer images, one that is hidden by a lorry decides.
_MIN_IMAGES = 2
_REMEDY = "Check that images are sorted by number or time (10 after 9, not after 1), and that none is missing."


def find_image_order(sample: LogSample, camera: Camera, few: CameraView | None = None) -> Finding | None:
    """Finds images that belong to the poses of other frames.

    Args:
        sample: the frames of a chunk.
        camera: one of its cameras.
        few: its view of ``FEW_IMAGES``, where it is at hand.

    Returns:
        ``images_out_of_order`` where the order is reversed, ``images_of_another_frame`` where all are early or late;
        ``None`` where neither is clear. A vehicle that stands, or images without edges, give no verdict.
    """
    few = few or view_camera(sample, camera, FEW_IMAGES, _MIN_PIXELS_PER_DEG)
    if few is None:
        return None
    _, score, best_score = _find_best_order(sample, few, _LIKELY_OFFSETS)
    if best_score < max(_MIN_SCORE, score + _LIKELY_MARGIN):
        return None
    many = view_camera(sample, camera, _MANY_IMAGES, _MIN_PIXELS_PER_DEG)
    if many is None:
        return None
    offset, score, best_score = _find_best_order(sample, many, _OFFSETS)
    if best_score < max(_MIN_SCORE, score + _MIN_MARGIN):
        return None
    return _describe(many, offset, score, best_score)


def _find_best_order(sample: LogSample, view: CameraView, offsets: tuple[int, ...]) -> tuple[int, float, float]:
    """Offset of the order that gains most, 0 for the reversed one; score of the log's order, and of that one."""
    poses = dict(zip(sample.frames, sample.world_SE3_camera(view.camera), strict=True))
    orders = {0: dict(zip(sample.frames, sample.frames[::-1], strict=True))}
    orders |= {offset: _shift(sample.frames, offset) for offset in offsets}
    compared = {offset: _compare_orders(view, poses, order) for offset, order in orders.items()}
    offset = max(compared, key=lambda offset: compared[offset][1] - compared[offset][0])
    return (offset, *compared[offset])


def _describe(view: CameraView, offset: int, score: float, best_score: float) -> Finding:
    camera = view.camera
    count = f"{abs(offset)} frame{'s' if abs(offset) > 1 else ''}"
    # Where the pose of a later frame fits, this frame's image is the one of an earlier number.
    cause = f"with the images {count} {'earlier' if offset > 0 else 'later'}" if offset else "in reversed order"
    message = (
        f"{camera.name}: edges of LiDAR and images agree poorly ({score:.1f} standard deviations above chance) and "
        f"better ({best_score:.1f}) {cause}"
    )
    numbers = {"score": score, "best_score": best_score, "min_margin": _MIN_MARGIN}
    if offset:
        numbers["offset_frames"] = float(-offset)
    word = "images_of_another_frame" if offset else "images_out_of_order"
    return Finding(word, "warning", message, _REMEDY, numbers, camera.name, tuple(view.image_edges))


def _shift(frames: tuple[int, ...], offset: int) -> dict[int, int]:
    """Each frame's other frame; the last ones, or the first ones, have none."""
    return {frame: frame + offset for frame in frames if frame + offset in frames}


def _compare_orders(view: CameraView, poses: dict[int, Float64], order: dict[int, int]) -> tuple[float, float]:
    """Scores of the same images at the poses of the log, and at those of another order; equal without a verdict."""
    own: dict[int, Float32] = {}
    other: dict[int, Float32] = {}
    for frame, other_frame in order.items():
        if frame not in view.points or not is_rigid_transform(poses[other_frame]):
            continue
        own[frame] = view.range_edges[frame]
        other[frame] = _view_edges(view, poses, frame, other_frame)
    edges = {frame: view.image_edges[frame] for frame in own}
    before = score_edges(own, edges)
    after = score_edges(other, edges)
    if len(own) < _MIN_IMAGES or before is None or after is None:
        return 0.0, 0.0
    return before.near.score, after.near.score


def _view_edges(view: CameraView, poses: dict[int, Float64], frame: int, other_frame: int) -> Float32:
    """Edges of a sweep from the pose of another frame: that frame's sweep, or the frame's own where it is not read."""
    if other_frame in view.points:
        return view.range_edges[other_frame]
    other_SE3_frame = np.linalg.inv(poses[other_frame]) @ poses[frame]
    # By einsum: a matrix product would start threads for a matrix of three columns.
    points = np.einsum("ni,ji->nj", view.points[frame], other_SE3_frame[:3, :3]) + other_SE3_frame[:3, 3]
    return find_range_edges(points, view.grid)
