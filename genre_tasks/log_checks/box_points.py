"""Whether annotated boxes lie where the LiDAR points of their objects are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import CuboidTrack, Float64

# So near, objects are hit by several beams unless something stands before them.
_MAX_DISTANCE_M = 25.0
# With fewer boxes, one that is hidden decides.
_MIN_BOXES = 4
# The lowest part of a box has points of the road in it wherever it is.
_GROUND_MARGIN_M = 0.25
# Around the box, where the road is not hidden by the object.
_RING_M = 1.0
_RING_HEIGHT_M = 5.0
_MIN_RING_POINTS = 10
# In sound logs 0.85 and more of the near boxes have points, in real ones too.
_MIN_FRACTION = 0.5
_MIN_EXPLAINED_FRACTION = 0.7
# Annotators set boxes on the road to 0.1 m; half a car's height is 0.75 m.
_MAX_OFF_GROUND_M = 0.4
_FRAME_REMEDY = "Give boxes, LiDAR points and poses in the same world frame, in metres, at the times of the frames."


@dataclass(frozen=True)
class _BoxPoints:
    """What the LiDAR points of one frame say of the near boxes.

    Attributes:
        has_points: [B] whether a box has a point above the road.
        off_ground_m: [B] height of its underside above the road around it; NaN where no road is seen.
        heights_m: [B] of the boxes.
    """

    has_points: NDArray[np.bool_]
    off_ground_m: Float64
    heights_m: Float64


def find_boxes_without_points(sample: LogSample) -> Iterator[Finding]:
    """Finds boxes that lie elsewhere than the LiDAR points, in one frame of the chunk.

    Args:
        sample: the frames of a chunk; one sweep is read, the last one that can be.

    Yields:
        ``boxes_without_points`` or ``boxes_off_ground``.
    """
    # Of the last frame: there the vehicle is farthest from where the world frame may begin.
    for frame in reversed(sample.frames):
        boxes = _boxes_at(sample.tracks, frame)
        if len(boxes) < _MIN_BOXES:
            continue
        sweep = sample.sweep(frame)
        pose = sample.world_SE3_lidar[sample.frames.index(frame)]
        if sweep is None or not len(sweep.points_world) or not np.isfinite(pose).all():
            continue
        yield from _judge_boxes(boxes, sweep.points_world, pose, frame)
        return


def _boxes_at(tracks: tuple[CuboidTrack, ...], frame: int) -> list[tuple[Float64, Float64]]:
    """World_SE3_box [4, 4] and size [3] of everything that is annotated in a frame."""
    boxes = []
    for track in tracks:
        index = np.flatnonzero(track.frames == frame)
        if index.size and np.isfinite(track.world_SE3_box[index[0]]).all() and np.isfinite(track.size_m).all():
            boxes.append((track.world_SE3_box[index[0]], np.array(track.size_m)))
    return boxes


def _judge_boxes(
    boxes: list[tuple[Float64, Float64]],
    points_world: Float64,  # [N, 3]
    world_SE3_lidar: Float64,  # [4, 4]
    frame: int,
) -> Iterator[Finding]:
    found = _compare(boxes, points_world, world_SE3_lidar)
    count = len(found.has_points)
    fraction = float(found.has_points.mean()) if count else 0.0
    if count >= _MIN_BOXES and fraction >= _MIN_FRACTION:
        yield from _judge_ground(found, frame)
        return
    moved = _compare([(world_SE3_lidar @ pose, size) for pose, size in boxes], points_world, world_SE3_lidar)
    explained = len(moved.has_points) >= _MIN_BOXES and moved.has_points.mean() >= _MIN_EXPLAINED_FRACTION
    # No box near the vehicle is an empty road, unless the boxes belong here in another frame.
    if count < _MIN_BOXES and not explained:
        return
    message = (
        f"only {int(found.has_points.sum())} of {count} boxes within {_MAX_DISTANCE_M:g} m have LiDAR points at frame "
        f"{frame}; {100 * _MIN_FRACTION:.0f} % are plausible at least"
    )
    remedy = "The boxes look as if given in the LiDAR's frame. " if explained else ""
    numbers = {"fraction": fraction, "limit": _MIN_FRACTION, "boxes": float(count)}
    yield Finding("boxes_without_points", "warning", message, remedy + _FRAME_REMEDY, numbers, frames=(frame,))


def _judge_ground(found: _BoxPoints, frame: int) -> Iterator[Finding]:
    """A finding where the boxes are above or below the road as a group."""
    measured = np.isfinite(found.off_ground_m)
    if measured.sum() < _MIN_BOXES:
        return
    median = float(np.median(found.off_ground_m[measured]))
    if abs(median) <= _MAX_OFF_GROUND_M:
        return
    half_height = float(np.median(found.heights_m[measured])) / 2
    direction = "above" if median > 0 else "below"
    message = (
        f"the undersides of {int(measured.sum())} boxes lie {abs(median):.2f} m {direction} the road at frame {frame}; "
        f"{_MAX_OFF_GROUND_M:g} m is plausible"
    )
    # The origin of a box is its centre here, and the middle of its underside in KITTI.
    is_half = abs(abs(median) - half_height) < _MAX_OFF_GROUND_M / 2
    remedy = "That is half their height: the origin of a box must be its centre. " if is_half else ""
    numbers = {"off_ground_m": median, "limit_m": _MAX_OFF_GROUND_M, "half_height_m": half_height}
    yield Finding("boxes_off_ground", "warning", message, remedy + _FRAME_REMEDY, numbers, frames=(frame,))


def _compare(
    boxes: list[tuple[Float64, Float64]],
    points_world: Float64,  # [N, 3]
    world_SE3_lidar: Float64,  # [4, 4]
) -> _BoxPoints:
    """Measures the boxes near the LiDAR."""
    center = world_SE3_lidar[:3, 3]
    reach = _MAX_DISTANCE_M + 2 * _RING_M
    nearby = points_world[(np.abs(points_world[:, :2] - center[:2]) < reach + _RING_HEIGHT_M).all(axis=1)]
    has_points = []
    off_ground_m = []
    heights_m = []
    for pose, size in boxes:
        if np.linalg.norm(pose[:2, 3] - center[:2]) > _MAX_DISTANCE_M:
            continue
        # Points around the box, before any of them is turned.
        radius = np.linalg.norm(size[:2]) / 2 + _RING_M
        around = nearby[(np.abs(nearby[:, :2] - pose[:2, 3]) < radius).all(axis=1)]
        local = (around - pose[:3, 3]) @ pose[:3, :3]
        height = local[:, 2] + size[2] / 2
        in_footprint = (np.abs(local[:, :2]) < size[:2] / 2).all(axis=1)
        inside = in_footprint & (height > min(_GROUND_MARGIN_M, size[2] / 2)) & (height < size[2])
        in_ring = (np.abs(local[:, :2]) < size[:2] / 2 + _RING_M).all(axis=1) & (np.abs(height) < _RING_HEIGHT_M)
        ground = np.percentile(height[in_ring], 5) if in_ring.sum() >= _MIN_RING_POINTS else np.nan
        has_points.append(bool(inside.any()))
        off_ground_m.append(-float(ground))
        heights_m.append(float(size[2]))
    return _BoxPoints(np.array(has_points, dtype=bool), np.array(off_ground_m), np.array(heights_m))
