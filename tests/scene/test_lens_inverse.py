"""The inverse of lens distortion finds the ray of every point that has one, also far from a straight lens."""

from __future__ import annotations

import numpy as np
import pytest

from genre_tasks.logs.brown_conrady import distort
from genre_tasks.scene.lens_distortion import fold_radius, undistort

# The first two are ordinary lenses, whose points are all found from the first start.
LENSES = [
    (-0.27, 0.12, 0.0, 0.0, -0.03),
    (0.1, 0.0, 0.001, 0.001, 0.0),
    (-0.5894, 0.66, 0.0011, -0.001, -0.2935),
    (0.2, -1.1, 0.0, 0.0, 1.6),
    (0.206, 0.579, -0.0002, 0.0016, -0.25),
    (0.247, 0.576, 0.002, 0.0007, -0.29),
]


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("angle", [0.0, 0.7, 2.3, 4.0])
def test_rays_within_the_fold_are_found(lens: tuple[float, ...], angle: float) -> None:
    radius = np.linspace(0, 0.95 * min(fold_radius(lens), 1.0), 200)
    u = radius * np.cos(angle)
    v = radius * np.sin(angle)
    x, y = distort(u, v, lens)
    found_u, found_v = undistort(x, y, lens)
    assert np.hypot(found_u - u, found_v - v).max() < 1e-8


def test_points_without_a_ray_stay_on_the_fold() -> None:
    lens = (-0.35, 0.15, 0.0, 0.0, -0.03)
    u, v = undistort(np.array([0.0, 3.0]), np.array([5.0, 4.0]), lens)
    assert np.allclose(np.hypot(u, v), fold_radius(lens))
