"""Whether the boxes of moving objects belong to the sweeps of their frames, or to those of other frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import CuboidTrack, Float64

# Boxes of so many frames earlier or later are tried, and those of the reversed log.
_OFFSETS = (-1, 1, -2, 2)
_SWEEPS = 3
# Farther away, few beams hit an object.
_MAX_DISTANCE_M = 50.0
# 2 m/s at 10 Hz: with a smaller step, both boxes hold the same points.
_MIN_STEP_M = 0.2
# The lowest part of a box has points of the road in it wherever it is.
_GROUND_MARGIN_M = 0.25
# Annotators set boxes to 0.1 m, and points lie on the surface.
_MARGIN_M = 0.1
# Fewer points at the ends of an object may be of something else.
_MIN_END_POINTS = 5
_MIN_POINTS = 20
# In sound logs, other frames gain far fewer points than they lose.
_MIN_VIEWS = 2
_MIN_RATIO = 4.0
_MIN_VIEW_FRACTION = 0.7
_REMEDY = (
    "Give boxes and LiDAR sweeps the same frames: check the order of the files of boxes and whether all are there."
)


@dataclass(frozen=True)
class _Order:
    """An order of frames that the boxes may have instead.

    Attributes:
        name: for the message.
        frames: by the frame of a sweep, the frame under which its boxes would be.
        offset: between the two; ``None`` where it is not the same everywhere.
    """

    name: str
    frames: dict[int, int]
    offset: int | None


@dataclass(frozen=True)
class _Evidence:
    """How the boxes of other frames fit the sweeps, each a sum over objects and sweeps.

    Attributes:
        inside: points in the boxes of their frames.
        inside_other: points in the boxes of the other frames.
        gained: points that only the boxes of the other frames hold.
        lost: points that only the boxes of their frames hold.
        views: objects in sweeps that tell the two apart.
        better_views: those of them in which the other frame fits better.
        frames: frames of those sweeps.
    """

    inside: int
    inside_other: int
    gained: int
    lost: int
    views: int
    better_views: int
    frames: tuple[int, ...]


def find_boxes_of_another_frame(sample: LogSample) -> Iterator[Finding]:
    """Finds boxes that fit the sweeps better when those of another frame are taken.

    Only what moves tells frames apart: a log where everything stands gives no verdict.

    Args:
        sample: the frames of a chunk; up to three sweeps are read.

    Yields:
        ``boxes_of_another_frame``, once at most.
    """
    movers = [track for track in sample.tracks if _moves(track)]
    sweeps = _read_sweeps(sample, movers)
    last = sample.log.frame_count - 1
    orders = [_Order(_name_offset(offset), {frame: frame + offset for frame in sweeps}, offset) for offset in _OFFSETS]
    orders.append(_Order("the reversed order", {frame: last - frame for frame in sweeps}, None))
    found = [(order, _gather_evidence(sweeps, movers, order)) for order in orders]
    clear = [(order, evidence) for order, evidence in found if _is_clear(evidence)]
    if not clear:
        return
    # The right order explains all objects; another one may by chance explain some of them as well.
    order, evidence = max(clear, key=lambda pair: (2 * pair[1].better_views - pair[1].views, pair[1].gained))
    message = (
        f"{evidence.inside} LiDAR points lie in the boxes of moving objects, and {evidence.inside_other} "
        f"where the boxes of {order.name} are taken"
    )
    numbers = {
        "points_inside": float(evidence.inside),
        "points_with_offset": float(evidence.inside_other),
        "limit_ratio": _MIN_RATIO,
    }
    if order.offset is not None:
        numbers["offset"] = float(order.offset)
    yield Finding("boxes_of_another_frame", "warning", message, _REMEDY, numbers, frames=evidence.frames)


def _name_offset(offset: int) -> str:
    frames = "1 frame" if abs(offset) == 1 else f"{abs(offset)} frames"
    return f"{frames} {'later' if offset > 0 else 'earlier'}"


def _moves(track: CuboidTrack) -> bool:
    """Whether an object goes somewhere from one frame to the next."""
    return bool(
        len(track.frames) > 1
        and np.isfinite(track.world_SE3_box).all()
        and np.isfinite(track.size_m).all()
        and (_steps_m(track) >= _MIN_STEP_M).any()
    )


def _steps_m(track: CuboidTrack) -> Float64:
    """[F - 1] how far an object goes between annotations."""
    return np.asarray(np.linalg.norm(np.diff(track.world_SE3_box[:, :3, 3], axis=0), axis=1))


def _read_sweeps(sample: LogSample, movers: list[CuboidTrack]) -> dict[int, Float64]:
    """[N, 3] points near the LiDAR by frame: the first, middle and last frame with moving objects."""
    annotated = {int(frame) for track in movers for frame in track.frames}
    indices = [index for index, frame in enumerate(sample.frames) if frame in annotated]
    if not indices:
        return {}
    sweeps = {}
    # Of a whole chunk, other checks read the same frames.
    for pick in sorted({k * (len(indices) - 1) // (_SWEEPS - 1) for k in range(_SWEEPS)}):
        frame = sample.frames[indices[pick]]
        sweep = sample.sweep(frame)
        position = sample.world_SE3_lidar[indices[pick], :3, 3]
        if sweep is None or not np.isfinite(position).all():
            continue
        is_near = (np.abs(sweep.points_world[:, :2] - position[:2]) < _MAX_DISTANCE_M).all(axis=1)
        near = sweep.points_world[is_near]
        # Sorted by x, so that the points around a box are found without looking at all of them.
        sweeps[frame] = near[np.argsort(near[:, 0])]
    return sweeps


def _gather_evidence(sweeps: dict[int, Float64], movers: list[CuboidTrack], order: _Order) -> _Evidence:
    """Compares the boxes of the sweeps' frames with those that another order puts there."""
    counts = []
    frames = set()
    for frame, points in sweeps.items():
        for track in movers:
            own_box = _box_at(track, frame)
            other_box = _box_at(track, order.frames[frame])
            if own_box is None or other_box is None:
                continue
            if np.linalg.norm(own_box[:3, 3] - other_box[:3, 3]) < _MIN_STEP_M:
                continue
            around = _points_around(points, np.stack([own_box, other_box]), track)
            own = _is_inside(own_box, track, around)
            other = _is_inside(other_box, track, around)
            row = (own.sum(), other.sum(), (other & ~own).sum(), (own & ~other).sum())
            if row[2] + row[3] >= _MIN_END_POINTS:
                counts.append(row)
                frames.add(frame)
    table = np.array(counts, dtype=np.int64).reshape(-1, 4)
    inside, inside_other, gained, lost = (int(total) for total in table.sum(axis=0))
    better = int((table[:, 2] > table[:, 3]).sum())
    return _Evidence(inside, inside_other, gained, lost, len(table), better, tuple(sorted(frames)))


def _box_at(track: CuboidTrack, frame: int) -> Float64 | None:
    """World_SE3_box [4, 4] of a frame; ``None`` where the object is not annotated."""
    index = np.flatnonzero(track.frames == frame)
    return track.world_SE3_box[index[0]] if index.size else None


def _points_around(
    points: Float64,  # [N, 3] sorted by x
    world_SE3_box: Float64,  # [B, 4, 4]
    track: CuboidTrack,
) -> Float64:  # [M, 3]
    """The points that may lie in boxes of an object."""
    reach_m = np.linalg.norm(track.size_m) / 2 + 2 * _MARGIN_M
    low = world_SE3_box[:, :2, 3].min(axis=0) - reach_m
    high = world_SE3_box[:, :2, 3].max(axis=0) + reach_m
    first, end = np.searchsorted(points[:, 0], (low[0], high[0]))
    strip = points[first:end]
    around = strip[(strip[:, 1] > low[1]) & (strip[:, 1] < high[1])]
    if not len(around):
        return around
    # Boxes below the road would hold points of it.
    return around[around[:, 2] > np.percentile(around[:, 2], 5) + _GROUND_MARGIN_M]


def _is_inside(
    world_SE3_box: Float64,  # [4, 4]
    track: CuboidTrack,
    points_world: Float64,  # [N, 3]
) -> NDArray[np.bool_]:  # [N]
    """Whether points lie in a box, above the road."""
    half_m = np.array(track.size_m) / 2 + _MARGIN_M
    local = (points_world - world_SE3_box[:3, 3]) @ world_SE3_box[:3, :3]
    above_road = local[:, 2] > _GROUND_MARGIN_M - track.size_m[2] / 2
    return (np.abs(local) < half_m).all(axis=1) & above_road


def _is_clear(evidence: _Evidence) -> bool:
    """Whether the other frames fit clearly better, for several objects or in several sweeps."""
    return (
        evidence.gained >= _MIN_POINTS
        and evidence.gained >= _MIN_RATIO * evidence.lost
        and evidence.better_views >= _MIN_VIEWS
        and evidence.better_views >= _MIN_VIEW_FRACTION * evidence.views
    )
