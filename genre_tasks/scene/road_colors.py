"""Colours of the road that no image saw, such as below the recording vehicle, from the road around it.

A lane away from the path cameras look at where the vehicle was, and the points there are road like any other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Points
from genre_tasks.scene.road_completion import REACH_M, measure_height_over_road
from genre_tasks.scene.transforms import distance_to_path

MAX_HEIGHT_M = 0.35
"""Points up to this far above or below the road's plane are of the road: kerbs and camber are, cars are not."""

PATCH_M = 0.5
"""Known colours are averaged over patches of this side: what is borrowed has no texture."""

# By the cube of the distance: the nearest patches decide, and yet no single one shows its outline.
_PATCHES = 64
_POWER = 3
# Added to distances, so that a patch right beside a point does not decide alone.
_SOFTENING_M = 0.25 * PATCH_M


def color_unseen_road(points: Points, chunk_SE3_ego: Float64) -> Points:
    """Colours the points on the road near the path that no image saw, by inverse distance weighting (Shepard 1968).

    Args:
        points: of the background, chunk coordinates.
        chunk_SE3_ego: [F, 4, 4].

    Returns:
        The points, those of the road with colours; the same object where all have one, or none of the road has.
    """
    from scipy.spatial import cKDTree

    if points.colored.all():
        return points
    near = np.flatnonzero(distance_to_path(points.positions, chunk_SE3_ego) < REACH_M)
    height = measure_height_over_road(points.positions.astype(np.float64), chunk_SE3_ego)[near]
    road = near[np.abs(height) < MAX_HEIGHT_M]
    known = road[points.colored[road]]
    unseen = road[~points.colored[road]]
    if not len(known) or not len(unseen):
        return points
    centres, patch_colors = _average_patches(points.positions[known, :2], points.colors[known])
    count = min(_PATCHES, len(centres))
    distance, nearest = cKDTree(centres).query(points.positions[unseen, :2], k=count)
    weight = 1.0 / (distance.reshape(-1, count) + _SOFTENING_M) ** _POWER
    blended = np.einsum("pk,pkc->pc", weight, patch_colors[nearest.reshape(-1, count)])
    colors = points.colors.copy()
    colors[unseen] = np.rint(blended / weight.sum(1, keepdims=True)).astype(np.uint8)
    colored = points.colored.copy()
    colored[unseen] = True
    return replace(points, colors=colors, colored=colored)


def _average_patches(xy: np.ndarray, colors: np.ndarray) -> tuple[Float64, Float64]:
    """Mean place [N, 2] and mean colour [N, 3] of the points in each square of ``PATCH_M``."""
    square = np.floor(xy / PATCH_M).astype(np.int64)
    patch_of = np.unique(square, axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(patch_of)[:, None]
    centres = np.stack([np.bincount(patch_of, values) for values in xy.T.astype(np.float64)], 1) / count
    means = np.stack([np.bincount(patch_of, values) for values in colors.T.astype(np.float64)], 1) / count
    return centres, means
