"""Whether LiDAR points are in the world's frame and in metres: around the path, above the ground, at their time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.log_checks.pose_conventions import find_measurable
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Float64
from genre_tasks.scene.transforms import is_rigid_transform

# Sweeps that are looked at, spread over the chunk: a wrong frame shows in each of them.
_SWEEPS = 3
# No LiDAR of a vehicle measures farther.
_MAX_RANGE_M = 300.0
# Radius in which nine tenths of a sweep lie. A garage has several metres, an open road hundreds.
_SPREAD_RANGE_M = (2.0, 400.0)
# The ground is looked for on this ring about the vehicle: nearer, there are its roof and bonnet.
_GROUND_RING_M = (3.0, 15.0)
# Height of the ground in the LiDAR's axes: below the highest roof of a lorry, and at the road itself.
_GROUND_HEIGHT_RANGE_M = (-4.5, 1.5)
# The lowest points of cells lie on the road, the highest ones on whatever stands there: their heights vary more.
_CELL_M = 2.0
_MIN_CELL_POINTS = 5
_MIN_CELLS = 20
_MAX_ROUGHNESS_RATIO = 2.0
_MIN_ROUGHNESS_M = 0.3
# Coarser than the noise of a LiDAR, points lie on visible steps.
_MAX_STEP_M = 0.02
_STEP_POINTS = 20_000
# A sweep ends or begins at its frame's time: its middle is half a period from it.
_MAX_TIME_OFFSET_PERIODS = 1.0
_WORLD_REMEDY = "Give points in world coordinates: apply the LiDAR's pose (sensor to world) to every sweep."
_UNIT_REMEDY = "Give points and poses in metres."


@dataclass(frozen=True)
class SweepLocation:
    """Where the points of a sweep lie.

    Attributes:
        frame: log frame.
        points: [N, 3] world coordinates, metres.
        in_lidar_axes: [N, 3] relative to the LiDAR's pose: x forward, y left, z up.
        time_offset_s: median time of the points after the frame's time; NaN where either is missing.
    """

    frame: int
    points: Float64
    in_lidar_axes: Float64
    time_offset_s: float


def find_misplaced_lidar(sample: LogSample) -> Iterator[Finding]:
    """Finds points that are not where a LiDAR on the vehicle would measure them.

    Args:
        sample: the frames of a chunk.

    Yields:
        ``lidar_far_from_path``, ``odd_lidar_scale``, ``lidar_upside_down``, ``odd_ground_height``,
        ``coarse_lidar_points`` or ``sweep_of_another_time``.
    """
    locations = list(_locate_sweeps(sample))
    if not locations:
        return
    spread_m = float(np.median([_measure_spread(location.points) for location in locations]))
    near = [np.linalg.norm(location.in_lidar_axes, axis=1) < _MAX_RANGE_M for location in locations]
    near_fraction = float(np.median([mask.mean() for mask in near]))
    frames = tuple(location.frame for location in locations)
    low, high = _SPREAD_RANGE_M
    if not low <= spread_m <= high:
        message = f"nine tenths of the LiDAR points lie within {spread_m:.3g} m of each other"
        numbers = {"spread_m": spread_m, "min_m": low, "max_m": high}
        yield Finding("odd_lidar_scale", "warning", message, _UNIT_REMEDY, numbers, frames=frames)
    if near_fraction < 0.5:
        distance_m = float(np.median([np.linalg.norm(np.median(x.in_lidar_axes, axis=0)) for x in locations]))
        message = f"{1 - near_fraction:.0%} of the LiDAR points lie more than {_MAX_RANGE_M:.0f} m from the vehicle"
        numbers = {"near_fraction": near_fraction, "distance_m": distance_m, "limit_m": _MAX_RANGE_M}
        yield Finding("lidar_far_from_path", "warning", message, _WORLD_REMEDY, numbers, frames=frames)
    else:
        yield from _find_wrong_ground(locations, frames)
    yield from _find_coarse_points(locations, frames)
    yield from _find_wrong_times(sample, locations)


def _locate_sweeps(sample: LogSample) -> Iterator[SweepLocation]:
    """Up to ``_SWEEPS`` sweeps with points and a pose."""
    count = len(sample.frames)
    for index in sorted({k * (count - 1) // (_SWEEPS - 1) for k in range(_SWEEPS)}):
        sweep = sample.sweep(sample.frames[index])
        pose = sample.world_SE3_lidar[index]
        if sweep is None or not is_rigid_transform(pose):
            continue
        points = sweep.points_world[find_measurable(sweep.points_world)]
        if not len(points):
            continue
        times = sweep.timestamps_s
        # A log without times of points has the same number, often 0, for all of them.
        offset_s = float(np.median(times) - sample.times_s[index]) if np.any(times) else np.nan
        # By einsum: a matrix product would start threads for a matrix of three columns.
        in_lidar_axes = np.einsum("ni,ij->nj", points - pose[:3, 3], pose[:3, :3])
        yield SweepLocation(sample.frames[index], points, in_lidar_axes, offset_s)


def _measure_spread(points: Float64) -> float:
    """Radius about the median point in which nine tenths of the points lie."""
    return float(np.quantile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 0.9))


def _find_wrong_ground(locations: list[SweepLocation], frames: tuple[int, ...]) -> Iterator[Finding]:
    """The ground has to lie below the points, and where wheels can be."""
    levels = [_measure_ground(location.in_lidar_axes) for location in locations]
    levels = [level for level in levels if np.isfinite(level).all()]
    if not levels:
        return
    height_m, low_roughness_m, high_roughness_m = map(float, np.median(levels, axis=0))
    low, high = _GROUND_HEIGHT_RANGE_M
    if low_roughness_m > max(_MAX_ROUGHNESS_RATIO * high_roughness_m, _MIN_ROUGHNESS_M):
        message = "the LiDAR points hang below a plane in place of standing on one: the z axis points down"
        numbers = {"lowest_roughness_m": low_roughness_m, "highest_roughness_m": high_roughness_m}
        remedy = "Give a world whose z axis points up, for points and poses alike."
        yield Finding("lidar_upside_down", "warning", message, remedy, numbers, frames=frames)
    elif not low <= height_m <= high:
        message = f"the ground lies at {height_m:.1f} m in the axes of the LiDAR's pose"
        numbers = {"height_m": height_m, "min_m": low, "max_m": high}
        remedy = "Check that points and poses have the same world, in metres, with z up."
        yield Finding("odd_ground_height", "warning", message, remedy, numbers, frames=frames)


def _measure_ground(points: Float64) -> tuple[float, float, float]:
    """Height of the ground, and how much the lowest and the highest points of cells vary, metres; NaN for too few."""
    distance_m = np.linalg.norm(points[:, :2], axis=1)
    around = points[(distance_m > _GROUND_RING_M[0]) & (distance_m < _GROUND_RING_M[1])]
    cells = np.floor((around[:, :2] + _GROUND_RING_M[1]) / _CELL_M).astype(np.int64)
    cell = cells[:, 0] * int(2 * _GROUND_RING_M[1] / _CELL_M + 1) + cells[:, 1]
    count = np.bincount(cell) if len(cell) else np.zeros(1, dtype=np.int64)
    lowest = np.full(len(count), np.inf)
    highest = np.full(len(count), -np.inf)
    np.minimum.at(lowest, cell, around[:, 2])
    np.maximum.at(highest, cell, around[:, 2])
    usable = count >= _MIN_CELL_POINTS
    if usable.sum() < _MIN_CELLS:
        return (np.nan, np.nan, np.nan)
    return (float(np.median(lowest[usable])), _measure_roughness(lowest[usable]), _measure_roughness(highest[usable]))


def _measure_roughness(heights: Float64) -> float:
    return float(np.median(np.abs(heights - np.median(heights))))


def _find_coarse_points(locations: list[SweepLocation], frames: tuple[int, ...]) -> Iterator[Finding]:
    """A float32 holds a map coordinate of 4 000 km to a quarter of a metre."""
    steps_m = []
    for location in locations:
        for axis in (0, 1):
            gaps = np.diff(np.unique(location.points[:_STEP_POINTS, axis]))
            steps_m.append(gaps.min() if len(gaps) else 0.0)
    # Both horizontal axes of all sweeps: a few points may well lie apart.
    step_m = float(np.min(np.reshape(steps_m, (-1, 2)).max(axis=1)))
    if step_m > _MAX_STEP_M:
        message = f"the coordinates of LiDAR points are rounded to {step_m:.2g} m"
        remedy = "Subtract an origin near the path, from points and poses alike, before you store them as float32."
        numbers = {"step_m": step_m, "limit_m": _MAX_STEP_M}
        yield Finding("coarse_lidar_points", "warning", message, remedy, numbers, frames=frames)


def _find_wrong_times(sample: LogSample, locations: list[SweepLocation]) -> Iterator[Finding]:
    """A sweep that was measured at the time of another frame is a file under a wrong name."""
    periods_s = np.abs(np.diff(sample.times_s))
    period_s = float(np.nanmedian(periods_s)) if np.isfinite(periods_s).any() else np.nan
    limit_s = _MAX_TIME_OFFSET_PERIODS * period_s
    wrong = [location for location in locations if abs(location.time_offset_s) > limit_s > 0]
    if wrong:
        offset_s = max((location.time_offset_s for location in wrong), key=abs)
        message = f"points were measured {offset_s:.3g} s from the time of their frame"
        remedy = "Check that sweeps have the numbers of their frames, and one clock."
        numbers = {"offset_s": offset_s, "limit_s": limit_s}
        frames = tuple(location.frame for location in wrong)
        yield Finding("sweep_of_another_time", "warning", message, remedy, numbers, frames=frames)
