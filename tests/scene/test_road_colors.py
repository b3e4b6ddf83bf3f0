"""Road that no image saw takes the colours of the road around it; nothing else does."""

from __future__ import annotations

import numpy as np

from genre_tasks.scene.chunk import NO_SWEEP, Points
from genre_tasks.scene.road_colors import color_unseen_road
from genre_tasks.scene.visibility import GREY

PATH = np.eye(4)[None]


def _road_with_hole(colors: np.ndarray, extra: np.ndarray | None = None) -> tuple[Points, np.ndarray]:
    """A road of 16 x 16 m whose middle no image saw, and points ``extra`` above it; which of them are the hole."""
    grid = np.mgrid[-8:8:0.1, -8:8:0.1].reshape(2, -1).T
    positions = np.column_stack([grid, np.full(len(grid), -1.8)])
    hole = np.abs(grid).max(1) < 2
    above = np.empty((0, 3)) if extra is None else extra
    values = np.concatenate([colors, np.full((len(above), 3), GREY)]).astype(np.uint8)
    hole = np.concatenate([hole, np.zeros(len(above), bool)])
    colored = ~hole & (np.arange(len(values)) < len(grid))
    values[~colored] = GREY
    all_positions = np.concatenate([positions, above]).astype(np.float32)
    frames = np.full(len(values), NO_SWEEP, np.int16)
    return Points(all_positions, values, colored, frames), hole


def test_unseen_road_takes_the_colour_of_the_road_beside_it() -> None:
    # Dark to the left, light to the right.
    x = np.mgrid[-8:8:0.1, -8:8:0.1][0].ravel()
    points, hole = _road_with_hole(np.where(x < 0, 40, 200)[:, None] * np.ones(3))
    out = color_unseen_road(points, PATH)
    assert out.colored.all() and np.array_equal(out.colors[~hole], points.colors[~hole])
    filled = out.colors[hole].astype(float)
    at = points.positions[hole]
    assert filled[at[:, 0] < -1.8].mean() < 70 and filled[at[:, 0] > 1.8].mean() > 170
    # No outline of a patch: neighbours differ by a few levels.
    row = filled[np.abs(at[:, 1]) < 0.01][:, 0]
    assert np.abs(np.diff(row)).max() < 15 and (np.diff(row) >= -1).all()


def test_what_stands_on_the_road_stays_without_a_colour() -> None:
    car = np.random.default_rng(0).uniform([3, 3, -1.2], [5, 5, -0.5], (500, 3))
    far = np.random.default_rng(1).uniform([20, 20, -1.8], [22, 22, -1.8], (500, 3))
    points, hole = _road_with_hole(np.full((160 * 160, 3), 90), np.concatenate([car, far]))
    out = color_unseen_road(points, PATH)
    assert (out.colors[hole] == 90).all()
    assert not out.colored[160 * 160 :].any() and (out.colors[160 * 160 :] == GREY).all()


def test_without_a_coloured_road_or_with_all_of_it_points_stay() -> None:
    points, _ = _road_with_hole(np.full((160 * 160, 3), 90))
    nothing = Points(points.positions, points.colors, np.zeros(len(points), bool), points.frames)
    assert color_unseen_road(nothing, PATH) is nothing
    everything = Points(points.positions, points.colors, np.ones(len(points), bool), points.frames)
    assert color_unseen_road(everything, PATH) is everything
    empty = Points(points.positions[:0], points.colors[:0], points.colored[:0], points.frames[:0])
    assert color_unseen_road(empty, PATH) is empty
