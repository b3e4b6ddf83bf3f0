"""Wide lenses: their rays, the pinholes that cover them, and the images that come of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import Float64
from genre_tasks.render.wide_lens import CoverTile, WideLens, cover_lens, fisheye_polynomial

FISHEYE = WideLens(
    width_px=400,
    height_px=240,
    center_px=(210.0, 115.0),
    matrix=(180.0, 0.0, 0.0, 170.0),
    angle_to_radius=fisheye_polynomial((-0.02, 0.003)),
)


def to_directions(angle: Float64, azimuth: Float64) -> Float64:
    radial = np.sin(angle)
    return np.stack([radial * np.cos(azimuth), radial * np.sin(azimuth), np.cos(angle)], -1)


def paint(tile: CoverTile) -> NDArray[np.uint8]:
    """An image of a pinhole whose colours are the directions of its rays in the wide lens's axes."""
    u = (np.arange(tile.lens.width_px) + 0.5 - tile.lens.cx_px) / tile.lens.fx_px
    v = (np.arange(tile.lens.height_px) + 0.5 - tile.lens.cy_px) / tile.lens.fy_px
    rays = np.stack(np.broadcast_arrays(u[None, :], v[:, None], 1.0), -1) @ tile.lens_R_tile.T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return np.rint(127.5 + 127.5 * rays).astype(np.uint8)


def test_pixels_show_the_rays_of_the_lens() -> None:
    cover = cover_lens(FISHEYE, 400, 240)
    assert len(cover.tiles) >= 3
    image = cover.resample([paint(tile) for tile in cover.tiles])
    angle, azimuth, arrives = FISHEYE.find_rays(400, 240)
    assert arrives.all()
    expected = 127.5 + 127.5 * to_directions(angle, azimuth)
    assert np.abs(image - expected).max() < 1.5


def test_a_half_sphere_takes_five_pinholes() -> None:
    lens = WideLens(300, 300, (150.0, 150.0), (90.0, 0.0, 0.0, 90.0), (0.0, 1.0), max_angle_rad=np.radians(95.0))
    cover = cover_lens(lens, 300, 300)
    assert len(cover.tiles) == 5
    image = cover.resample([paint(tile) for tile in cover.tiles])
    angle, azimuth, arrives = lens.find_rays(300, 300)
    assert np.abs(image - (127.5 + 127.5 * to_directions(angle, azimuth)))[arrives].max() < 2
    assert not arrives.all()
    assert (image[~arrives] == 0).all()


def test_rays_project_back_to_their_pixels() -> None:
    angle, azimuth, _ = FISHEYE.find_rays(400, 240)
    radius = np.polynomial.polynomial.polyval(angle, FISHEYE.angle_to_radius)
    u = 180.0 * radius * np.cos(azimuth) + 210.0
    v = 170.0 * radius * np.sin(azimuth) + 115.0
    assert u == pytest.approx(np.broadcast_to(np.arange(400) + 0.5, (240, 400)), abs=1e-3)
    assert v == pytest.approx(np.broadcast_to(np.arange(240)[:, None] + 0.5, (240, 400)), abs=1e-3)


def test_both_directions_of_a_polynomial_mean_the_same_lens() -> None:
    forward = WideLens(400, 240, (200.0, 120.0), (1.0, 0.0, 0.0, 1.0), angle_to_radius=(0.0, 180.0))
    backward = WideLens(400, 240, (200.0, 120.0), (1.0, 0.0, 0.0, 1.0), radius_to_angle=(0.0, 1 / 180.0))
    for one, other in zip(forward.find_rays(80, 48), backward.find_rays(80, 48), strict=True):
        assert one == pytest.approx(other)
    assert forward.measure_focal_px(80, 48) == pytest.approx(backward.measure_focal_px(80, 48)) == 36.0


def test_a_linear_term_shears_the_image() -> None:
    sheared = replace(FISHEYE, matrix=(1.0, 0.1, 0.05, 1.0), angle_to_radius=(0.0, 180.0))
    angle, azimuth, _ = sheared.find_rays(400, 240)
    x = 180.0 * angle * np.cos(azimuth)
    y = 180.0 * angle * np.sin(azimuth)
    assert x + 0.1 * y + 210.0 == pytest.approx(np.broadcast_to(np.arange(400) + 0.5, (240, 400)), abs=1e-2)
    assert 0.05 * x + y + 115.0 == pytest.approx(np.broadcast_to(np.arange(240)[:, None] + 0.5, (240, 400)), abs=1e-2)


def test_no_ray_is_past_the_place_where_a_lens_folds_back() -> None:
    folding = replace(FISHEYE, angle_to_radius=(0.0, 1.0, 0.0, -0.4))
    angle, _, arrives = folding.find_rays(400, 240)
    fold = 1 / np.sqrt(3 * 0.4)
    assert not arrives.all()
    assert angle[arrives].max() <= fold + 1e-3


def test_a_thin_strip_is_widened_for_the_renderer() -> None:
    # Sees 46° to each side: of the left and right pinholes a few columns are shown.
    lens = WideLens(400, 40, (200.0, 20.0), (200 / np.radians(46.0), 0.0, 0.0, 248.0), angle_to_radius=(0.0, 1.0))
    for tile in cover_lens(lens, 400, 40).tiles:
        assert abs(tile.lens.cx_px - tile.lens.width_px / 2) <= 3 * tile.lens.width_px
        assert abs(tile.lens.cy_px - tile.lens.height_px / 2) <= 3 * tile.lens.height_px


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"matrix": (0.0, 0.0, 0.0, 0.0)}, InputError),
        ({"matrix": (1.0, 1.0, 1.0, 1.0)}, InputError),
        ({"angle_to_radius": (5.0,)}, InputError),
        ({"angle_to_radius": (0.0, -1.0)}, InputError),
        ({"angle_to_radius": (0.0, 0.0, 1.0)}, InputError),
        ({"angle_to_radius": (), "radius_to_angle": (0.0, 0.0, 1.0)}, InputError),
        ({"angle_to_radius": (0.0, 1e300, 1e308)}, InputError),
        ({"center_px": (1e6, 1e6), "max_angle_rad": 1.0}, InputError),
        ({"matrix": (60.0, 0.0, 0.0, 60.0), "angle_to_radius": (0.0, 1.0)}, ConfigError),
    ],
)
def test_what_is_no_lens_is_refused(changes: dict[str, object], error: type[Exception]) -> None:
    with pytest.raises(error):
        cover_lens(replace(FISHEYE, **changes), 40, 24)  # type: ignore[arg-type]
