"""The road where LiDAR is blind: around the vehicle itself and between the rings of a slow drive.

A roof LiDAR sees no road nearer than some 4 m, and the number of Gaussians never grows: without these points the road
beside the path would stay a hole in every view. They are coloured from the images like all others.
"""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.types import Float32, Float64

REACH_M = 9.0
"""Only this near to the path: farther away rings are close and the road is not known to be flat."""

CELL_M = 0.1
_COARSE_M = 1.0
_SMOOTH_M = 0.8
_PLANE_TOLERANCE_M = 0.35
"""A coarse cell's lowest point this near to the fitted road plane is road: kerbs and camber stay, cars do not."""

_MIN_COARSE_CELLS = 20
_LOWEST_PERCENT = 2.0
_PLANE_WEIGHT = 1e-3
"""Weight of the plane in a cell's height, where a cell with road points has 1: it decides far from all of them."""


def road_fill(positions: Float32, chunk_SE3_ego: Float64) -> Float32:
    """Points [M, 3] on a 10 cm grid of road cells near the path that hold no road point in ``positions`` [P, 3].

    Heights are a local average of road points around, and a plane where there are none. Empty if the points show no
    road (fewer than 20 m² of it).
    """
    from scipy.ndimage import gaussian_filter, maximum_filter

    path = chunk_SE3_ego[:, :2, 3]
    low = path.min(0) - REACH_M
    shape = np.ceil((path.max(0) + REACH_M - low) / CELL_M).astype(int)
    cell = np.floor((positions[:, :2] - low) / CELL_M).astype(np.int64)
    inside = ((cell >= 0) & (cell < shape)).all(1)
    near, cell = positions[inside].astype(np.float64), cell[inside]
    plane = _road_plane(near, low)
    if plane is None:
        return np.empty((0, 3), np.float32)
    height = near[:, 2] - _at(plane, near[:, :2])
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
    distance = np.min([np.hypot(*np.moveaxis(centres - p, -1, 0)) for p in path], axis=0)
    empty = (maximum_filter(count, 3) == 0) & (distance < REACH_M)
    ground = centres[empty]
    return np.column_stack([ground, _at(plane, ground) + smooth[empty]]).astype(np.float32)


def height_over_road(positions: Float64, chunk_SE3_ego: Float64) -> Float64:
    """Metres [P] above the road plane near the path; above the lowest points where they show no road."""
    path = chunk_SE3_ego[:, :2, 3]
    low, high = path.min(0) - REACH_M, path.max(0) + REACH_M
    inside = ((positions[:, :2] >= low) & (positions[:, :2] < high)).all(1)
    plane = _road_plane(positions[inside], low)
    if plane is None:
        return positions[:, 2] - (np.percentile(positions[:, 2], _LOWEST_PERCENT) if len(positions) else 0.0)
    return positions[:, 2] - _at(plane, positions[:, :2])


def _at(plane: Float64, xy: Float64) -> Float64:
    return plane[0] + xy @ plane[1:]


def _road_plane(points: Float64, low: Float64) -> Float64 | None:
    """z = p0 + p1 x + p2 y through the lowest points of coarse cells, refitted to those that agree."""
    if not len(points):
        return None
    coarse = np.floor((points[:, :2] - low) / _COARSE_M).astype(np.int64)
    key = coarse[:, 0] * 100_000 + coarse[:, 1]
    order = np.lexsort((points[:, 2], key))
    first = np.unique(key[order], return_index=True)[1]
    lowest = points[order[first]]
    plane = np.array([np.median(lowest[:, 2]), 0.0, 0.0])
    for tolerance in (1.0, 0.6, _PLANE_TOLERANCE_M, _PLANE_TOLERANCE_M):
        agree = lowest[np.abs(lowest[:, 2] - _at(plane, lowest[:, :2])) < tolerance]
        if len(agree) < _MIN_COARSE_CELLS:
            return None
        design = np.column_stack([np.ones(len(agree)), agree[:, :2]])
        plane = np.linalg.lstsq(design, agree[:, 2], rcond=None)[0]
    return plane
