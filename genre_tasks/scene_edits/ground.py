"""The height and slope of the ground under a run's traffic, from LiDAR points and from what stands on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.logs.types import Float64

CELL_M = 0.5
"""The lowest points of cells of this size stand for the ground."""

_LOW_PERCENT = 10.0
_REACH_M = 6.0
_SIGMA_M = 2.0
# Points this far from the height that traffic nearby stands on are no ground: walls, signs, stray reflections.
_WINDOW_M = 1.2
_ABOVE_M = 0.08
_BELOW_M = 0.25
_ITERATIONS = 6
# Weight of a level plane at the height of the traffic nearby, where a cell right at the place has 1.
_PRIOR_WEIGHT = 0.02
_MAX_SLOPE = 0.3


@dataclass(frozen=True)
class Ground:
    """The ground of a run, in world coordinates.

    Attributes:
        cells: [C, 3] low points of cells that LiDAR saw.
        anchors: [A, 3] where the ego vehicle and actors stand.
    """

    cells: Float64
    anchors: Float64

    @staticmethod
    def from_points(points: Float64, path: EgoPath, bottoms: Sequence[Float64]) -> Ground:
        """Gathers what is known of the ground.

        Args:
            points: [P, 3] points of the background in world coordinates.
            path: the recorded path of the ego vehicle.
            bottoms: for each actor the middles of its box's lower face [F, 3] in world coordinates.
        """
        cells = thin_ground_points(points)
        ego = path.world_SE3_ego[:, :3, 3]
        under_ego = ego - [0.0, 0.0, _measure_ego_height(cells, ego, bottoms)]
        return Ground(cells, np.concatenate([under_ego, *bottoms]))

    def measure(self, places: Float64) -> tuple[Float64, Float64]:
        """Measures the ground at places.

        Args:
            places: [M, 2] metres in world coordinates.

        Returns:
            Heights [M] in metres, and upward unit normals [M, 3]. Where LiDAR saw no ground, the height is that of
            the traffic nearby and the ground is level.
        """
        tree = cKDTree(self.cells[:, :2]) if len(self.cells) else None
        anchors = cKDTree(self.anchors[:, :2])
        heights = np.zeros(len(places))
        normals = np.zeros((len(places), 3))
        for k, place in enumerate(places):
            prior = self._anchor_height(anchors, place)
            near = tree.query_ball_point(place, _REACH_M) if tree is not None else []
            heights[k], slope = _fit_plane(self.cells[near] - [*place, prior])
            heights[k] += prior
            normals[k] = np.array([-slope[0], -slope[1], 1.0])
        return heights, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def _anchor_height(self, tree: cKDTree, place: Float64) -> float:
        # The median of the nearest ones, as single boxes are annotated too high or too low.
        count = min(9, len(self.anchors))
        _, nearest = tree.query(place, k=count)
        return float(np.median(self.anchors[np.atleast_1d(nearest), 2]))


def thin_ground_points(points: Float64) -> Float64:
    """Reduces points to one low point for each cell of the ground.

    Args:
        points: [P, 3] metres.

    Returns:
        [C, 3] the mean place and the tenth percentile of the heights in each cell.
    """
    if not len(points):
        return np.zeros((0, 3))
    keys = np.floor(points[:, :2] / CELL_M).astype(np.int64)
    keys -= keys.min(0)
    # One number for each cell: rows of two would be sorted ten times as slowly.
    _, cell_of = np.unique(keys[:, 0] * (keys[:, 1].max() + 1) + keys[:, 1], return_inverse=True)
    order = np.lexsort((points[:, 2], cell_of))
    counts = np.bincount(cell_of)
    starts = np.cumsum(counts) - counts
    low = order[starts + np.floor(counts * _LOW_PERCENT / 100).astype(np.int64)]
    means = [np.bincount(cell_of, points[:, k]) / counts for k in (0, 1)]
    return np.stack([*means, points[low, 2]], 1)


def _measure_ego_height(cells: Float64, ego: Float64, bottoms: Sequence[Float64]) -> float:
    # How high the origin of the ego vehicle is above the ground: most often a LiDAR on the roof.
    heights = []
    tree = cKDTree(cells[:, :2]) if len(cells) else None
    for position in ego:
        near = cells[tree.query_ball_point(position[:2], 3.0), 2] if tree is not None else np.zeros(0)
        near = near[(near < position[2] + 0.1) & (near > position[2] - 4.0)]
        if len(near) >= 5:
            heights.append(position[2] - float(np.percentile(near, 25)))
    if heights:
        return float(np.median(heights))
    if bottoms:
        return float(np.median(ego[:, 2])) - float(np.median(np.concatenate(bottoms)[:, 2]))
    return 0.0


def _fit_plane(offsets: Float64) -> tuple[float, Float64]:
    # Height and slope at the origin of a plane through the lower envelope of points [C, 3] around it.
    near = offsets[np.abs(offsets[:, 2]) < _WINDOW_M + 0.2 * np.linalg.norm(offsets[:, :2], axis=1)]
    design = np.concatenate([np.ones((len(near), 1)), near[:, :2]], 1)
    proximity = np.exp(-np.square(near[:, :2]).sum(1) / (2 * _SIGMA_M**2))
    # The prior keeps the fit defined where points are few, and does not count where they are many.
    prior = np.diag([_PRIOR_WEIGHT, _PRIOR_WEIGHT * _SIGMA_M**2, _PRIOR_WEIGHT * _SIGMA_M**2])
    plane = np.zeros(3)
    if len(near):
        plane[0] = np.percentile(near[:, 2], 30)
    for _ in range(_ITERATIONS):
        residual = near[:, 2] - design @ plane
        scale = np.where(residual > 0, _ABOVE_M, _BELOW_M)
        weight = proximity / np.square(1 + np.square(residual / scale))
        plane = np.linalg.solve(design.T @ (weight[:, None] * design) + prior, design.T @ (weight * near[:, 2]))
        plane[1:] *= min(1.0, _MAX_SLOPE / max(float(np.linalg.norm(plane[1:])), 1e-9))
    return float(plane[0]), plane[1:]
