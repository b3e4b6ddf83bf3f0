"""The road of a scene's depth, made smooth: lane markings break up where points beside each other differ in height.

A render's depth is right within centimetres near the path, and seen from beside it each centimetre moves a marking.
A road has no such steps, so that its points may take the height of the road around them.
"""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.road_completion import CELL_M, measure_height_over_road, span_road_grid

_SMOOTH_M = 0.5
# Heights of the road over its plane, where it is fitted: kerbs and camber stay, cars do not.
_MAX_CAMBER_M = 0.35
_MAX_STEP_M = 0.2
_MIN_ROAD_M2 = 20
# Where no point of the road is near, the plane decides.
_PLANE_WEIGHT = 1e-3


def smooth_road(positions: Float32, reliable: Float32, chunk_SE3_ego: Float64) -> Float32:
    """Moves points on the road near the path up or down, onto a smooth surface.

    Args:
        positions: [P, 3] metres, chunk coordinates.
        reliable: [R, 3] those of them that decide where the road is.
        chunk_SE3_ego: [F, 4, 4].

    Returns:
        [P, 3]; the same points where ``reliable`` shows less than 20 m² of road.
    """
    from scipy.ndimage import gaussian_filter

    path = chunk_SE3_ego[:, :2, 3]
    low, shape = span_road_grid(path)
    near = reliable[_find_cells(reliable, low, shape)[1]].astype(np.float64)
    over_plane = measure_height_over_road(near, chunk_SE3_ego)
    squares = np.unique(np.floor(near[np.abs(over_plane) < _MAX_CAMBER_M, :2]), axis=0)
    if len(squares) < _MIN_ROAD_M2:
        return positions
    # Heights are over a plane, which their differences from the points give back.
    design = np.column_stack([np.ones(len(near)), near[:, :2]])
    plane = np.linalg.lstsq(design, near[:, 2] - over_plane, rcond=None)[0]
    cells, inside = _find_cells(positions, low, shape)
    points = positions[inside].astype(np.float64)
    base = plane[0] + points[:, :2] @ plane[1:]
    height = points[:, 2] - base
    cell = np.ravel_multi_index((cells[inside, 0], cells[inside, 1]), shape)
    is_road = np.abs(height) < _MAX_CAMBER_M
    known, medians = _take_medians(cell[is_road], height[is_road])
    count = np.zeros(shape.prod())
    count[known] = 1
    total = np.zeros(shape.prod())
    total[known] = medians
    sigma = _SMOOTH_M / CELL_M
    weight = gaussian_filter(count.reshape(shape), sigma) + _PLANE_WEIGHT
    smooth = (gaussian_filter(total.reshape(shape), sigma) / weight).ravel()[cell]
    moved = np.abs(height - smooth) < _MAX_STEP_M
    out = positions.copy()
    out[np.flatnonzero(inside)[moved], 2] = (base + smooth)[moved].astype(np.float32)
    return out


def _find_cells(points: Float32, low: Float64, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells [P, 2] of the grid around the path, and whether a point is inside [P]."""
    cells = np.floor((points[:, :2] - low) / CELL_M).astype(np.int64)
    inside = np.all((cells >= 0) & (cells < shape), axis=1)
    return cells, inside


def _take_medians(groups: np.ndarray, values: Float64) -> tuple[np.ndarray, Float64]:
    """The groups that have values, and the upper median of each."""
    order = np.lexsort((values, groups))
    ordered = groups[order]
    starts = np.flatnonzero(np.concatenate([np.ones(min(len(ordered), 1), bool), np.diff(ordered) > 0]))
    ends = np.append(starts[1:], len(ordered))
    return ordered[starts], values[order][(starts + ends) // 2]
