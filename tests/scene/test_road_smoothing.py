"""Road points of a scene's depth take the height of the road around them; what stands on the road stays."""

from __future__ import annotations

import numpy as np
import pytest

from genre_tasks.scene.road_smoothing import smooth_road


@pytest.mark.parametrize("slope", [0.0, 0.05])
def test_a_rough_road_becomes_smooth(slope: float) -> None:
    random = np.random.default_rng(0)
    grid = np.mgrid[-9:9:0.05, -9:9:0.05].reshape(2, -1).T
    # With a camber, which no plane has.
    height = slope * grid[:, 0] - 1.8 - 0.002 * grid[:, 1] ** 2
    road = np.column_stack([grid, height + random.normal(0, 0.04, len(grid))]).astype(np.float32)
    box = random.uniform([5, 5, -1.0], [7, 7, 0.0], (500, 3)).astype(np.float32)
    smooth = smooth_road(np.concatenate([road, box]), road, np.eye(4)[None])
    inner = np.abs(grid).max(1) < 7
    error = smooth[: len(road), 2] - height
    assert np.abs(error[inner]).max() < 0.03 < np.abs(road[inner, 2] - height[inner]).max()
    assert (smooth[:, :2] == np.concatenate([road, box])[:, :2]).all()
    assert (smooth[len(road) :] == box).all()


def test_without_a_road_points_stay() -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (200, 3)).astype(np.float32)
    assert smooth_road(points, points, np.eye(4)[None]) is points
    assert smooth_road(points, points[:0], np.eye(4)[None]) is points
    far = points + np.float32(100)
    assert smooth_road(far, far, np.eye(4)[None]) is far
