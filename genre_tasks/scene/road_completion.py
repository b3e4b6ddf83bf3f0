"""The road where LiDAR is blind: around the vehicle itself and between the rings of a slow drive.

A roof LiDAR sees no road nearer than some 4 m, and splitting adds Gaussians only where there are some: without these
points the road beside the path would stay a hole in every view. They are coloured from the images like all others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float32, Float64

REACH_M = 9.0
"""Only this near to the path: farther away rings are close and the road is not known to be flat."""

CELL_M = 0.1
# Some 2.5 GB; a straight road of 750 m across the grid has as many.
_MOST_CELLS = 3e7
_COARSE_M = 1.0
_SMOOTH_M = 0.8
# A coarse cell's lowest point this near to the fitted road plane is road: kerbs and camber stay, cars do not.
_PLANE_TOLERANCE_M = 0.35

_MIN_COARSE_CELLS = 20
_LOWEST_PERCENT = 2.0
# Weight of the plane in a cell's height, where a cell with road points has 1: it decides far from all of them.
_PLANE_WEIGHT = 1e-3


def complete_road(positions: Float32, chunk_SE3_ego: Float64) -> Float32:
    """Adds points on the road near the path where LiDAR has none: on a 10 cm grid of cells without a road point.

    Heights are a local average of the road points around, and a plane where there are none.

    Args:
        positions: [P, 3] LiDAR points of the background, chunk coordinates.
        chunk_SE3_ego: [F, 4, 4].

    Returns:
        Points [M, 3]; none if ``positions`` show less than 20 m² of road.
    """
    from scipy.ndimage import gaussian_filter, maximum_filter

    path = chunk_SE3_ego[:, :2, 3]
    low, shape = span_road_grid(path)
    cell = np.floor((positions[:, :2] - low) / CELL_M).astype(np.int64)
    inside = ((cell >= 0) & (cell < shape)).all(1)
    near = positions[inside].astype(np.float64)
    cell = cell[inside]
    plane = _fit_road_plane(near, low)
    if plane is None:
        return np.empty((0, 3), np.float32)
    height = near[:, 2] - _plane_height(plane, near[:, :2])
    road = np.abs(height) < _PLANE_TOLERANCE_M
    # The lowest point of each cell stands for it: a wall's foot or a tyre would lift the mean.
    flat = np.ravel_multi_index((cell[road, 0], cell[road, 1]), shape)
    lowest = np.full(shape.prod(), np.inf)
    np.minimum.at(lowest, flat, height[road])
    known = np.isfinite(lowest)
    count = known.astype(np.float64).reshape(shape)
    total = np.where(known, lowest, 0.0).reshape(shape)
    sigma = _SMOOTH_M / CELL_M
    # Over the plane, so that the plane's own height is 0 and enters only the denominator.
    smooth = gaussian_filter(total, sigma) / (gaussian_filter(count, sigma) + _PLANE_WEIGHT)
    centres = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in shape), indexing="ij"), -1) * CELL_M + low
    distance = np.full(centres.shape[:-1], np.inf)
    # Pose after pose: all distances at once would take gigabytes where a chunk is long.
    for position in path:
        np.minimum(distance, np.hypot(*np.moveaxis(centres - position, -1, 0)), out=distance)
    # Grown by a cell, so that no added point touches a real one.
    empty = (maximum_filter(count, 3) == 0) & (distance < REACH_M)
    added = centres[empty]
    return np.column_stack([added, _plane_height(plane, added) + smooth[empty]]).astype(np.float32)


def span_road_grid(path: Float64) -> tuple[Float64, NDArray[np.int64]]:
    """Spans a grid of cells of ``CELL_M`` around a path.

    Args:
        path: [F, 2] metres, chunk coordinates.

    Returns:
        The grid's corner [2] in metres, and its numbers of cells [2].

    Raises:
        InputError: the path is so long that the grid would take gigabytes.
    """
    low = path.min(0) - REACH_M
    sides = np.ceil((path.max(0) + REACH_M - low) / CELL_M)
    # A single wrong pose, such as one at the origin of a map, is enough for that.
    if sides.prod() > _MOST_CELLS:
        extent_m = float((path.max(0) - path.min(0)).max())
        remedy = "Correct the poses, leave the chunk out with --chunks, or set a smaller ingest.chunk_frames."
        raise InputError(f"the chunk's path spans {extent_m:.0f} m", remedy=remedy)
    return low, sides.astype(np.int64)


def measure_height_over_road(positions: Float64, chunk_SE3_ego: Float64) -> Float64:
    """Measures how high points are above the road plane near the path.

    Args:
        positions: [P, 3] metres, chunk coordinates.
        chunk_SE3_ego: [F, 4, 4].

    Returns:
        Metres [P]; above the lowest points where ``positions`` show no road.
    """
    path = chunk_SE3_ego[:, :2, 3]
    low = path.min(0) - REACH_M
    high = path.max(0) + REACH_M
    inside = ((positions[:, :2] >= low) & (positions[:, :2] < high)).all(1)
    plane = _fit_road_plane(positions[inside], low)
    if plane is None:
        return positions[:, 2] - (np.percentile(positions[:, 2], _LOWEST_PERCENT) if len(positions) else 0.0)
    return positions[:, 2] - _plane_height(plane, positions[:, :2])


def _plane_height(plane: Float64, xy: Float64) -> Float64:
    return plane[0] + xy @ plane[1:]


def _fit_road_plane(points: Float64, low: Float64) -> Float64 | None:
    # Fits z = p0 + p1 x + p2 y to the lowest points of coarse cells, and again to those that agree with it.
    if not len(points):
        return None
    # The lowest point of a square metre is road unless something stands on all of it.
    coarse = np.floor((points[:, :2] - low) / _COARSE_M).astype(np.int64)
    key = coarse[:, 0] * 100_000 + coarse[:, 1]
    order = np.lexsort((points[:, 2], key))
    first = np.unique(key[order], return_index=True)[1]
    lowest = points[order[first]]
    plane = np.array([np.median(lowest[:, 2]), 0.0, 0.0])
    # The tolerance narrows: the first plane is level, and a sloping road is more than the last one away from it.
    for tolerance in (1.0, 0.6, _PLANE_TOLERANCE_M, _PLANE_TOLERANCE_M):
        agree = lowest[np.abs(lowest[:, 2] - _plane_height(plane, lowest[:, :2])) < tolerance]
        if len(agree) < _MIN_COARSE_CELLS:
            return None
        design = np.column_stack([np.ones(len(agree)), agree[:, :2]])
        plane = np.linalg.lstsq(design, agree[:, 2], rcond=None)[0]
    return plane
