"""Meshes, noise and textures of the synthetic street."""

import numpy as np
import pytest

from genre_tasks.logs.synthetic.camera_images import to_srgb
from genre_tasks.logs.synthetic.materials import MIRROR, REFLECTIVITY, Material
from genre_tasks.logs.synthetic.mesh import Mesh, boxes, ellipsoid, joined, linear, tube
from genre_tasks.logs.synthetic.noise import cell, dot3, fractal, noise, rotated, seam, stripe
from genre_tasks.logs.synthetic.textures import TEXTURES, albedo


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[:, k] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def volume(mesh: Mesh) -> float:
    """Of a star-shaped surface about the origin, whatever the faces' orientation."""
    a, b, c = (mesh.vertices[:, k] for k in range(3))
    return float(np.abs(np.einsum("ni,ni->n", a, np.cross(b, c))).sum() / 6)


def test_primitives_have_the_right_area_and_volume():
    box = boxes((-1, -1, -1), (1, 2, 3), 0, (0.5, 0.5, 0.5))
    assert len(box) == 12 and area(box) == pytest.approx(2 * (2 * 3 + 2 * 4 + 3 * 4))
    assert volume(box) == pytest.approx(24)
    ball = ellipsoid((0, 0, 0), (1, 1, 1), 0, (0.5, 0.5, 0.5), level=3)
    assert volume(ball) == pytest.approx(4 / 3 * np.pi, rel=0.02)
    can = tube([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], [1.0, 1.0], 64, 0, (0.5, 0.5, 0.5))
    assert volume(can) == pytest.approx(2 * np.pi, rel=0.01)


def test_a_placed_mesh_keeps_its_texture():
    box = boxes((0, 0, 0), (1, 1, 1), 0, (0.5, 0.5, 0.5))
    pose = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1.0]])
    moved = box.placed(pose)
    np.testing.assert_array_equal(moved.texture, box.texture)
    np.testing.assert_allclose(moved.vertices.reshape(-1, 3).min(0), [4, 6, 7])
    assert len(joined([box, moved])) == 24 and len(joined([])) == 0


def test_colour_space_round_trip():
    levels = np.arange(256)
    np.testing.assert_array_equal(to_srgb(linear(levels / 255)), levels)


def test_noise_is_smooth_bounded_and_periodic():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-300, 300, (2, 5000)).astype(np.float32)
    value = noise(x, y)
    assert value.min() >= 0 and value.max() <= 1 and value.std() > 0.1
    assert np.abs(noise(x + np.float32(1e-3), y) - value).max() < 5e-3
    whole = np.arange(-4, 4, dtype=np.float32)
    np.testing.assert_array_equal(noise(whole, whole), cell(whole, whole))
    np.testing.assert_array_equal(cell(whole, whole), cell(whole + 256, whole - 256))
    assert np.abs(fractal(x, y, 4) - fractal(x, y, 4, stream=5)).mean() > 0.05


def test_lines_keep_their_mean_when_blurred():
    x = np.linspace(-6, 6, 24_001).astype(np.float32)
    for blur in (0.01, 0.1, 0.4, 3.0):
        assert seam(x, 1.0, 0.2, np.full_like(x, blur)).mean() == pytest.approx(0.2, abs=0.03)
    line = stripe(x, 1.0, 0.5, np.full_like(x, 0.01))
    assert line[np.abs(x - 1) < 0.24].min() == 1 and line[np.abs(x - 1) > 0.26].max() == 0


def test_rotated_is_a_matrix_product():
    rng = np.random.default_rng(1)
    r, v = rng.normal(size=(3, 3)), rng.normal(size=(10, 3))
    np.testing.assert_allclose(rotated(r, v), v @ r.T)
    np.testing.assert_allclose(dot3(v, v), (v**2).sum(1))


def test_every_material_is_complete():
    assert set(TEXTURES) == set(Material)
    assert len(REFLECTIVITY) == len(MIRROR) == len(Material)


@pytest.mark.parametrize("material", list(Material))
@pytest.mark.parametrize("blur", [1e-4, 0.05, 10.0])
def test_albedo_is_finite_and_bounded(material: Material, blur: float):
    rng = np.random.default_rng(2)
    n = 2000
    p = rng.uniform(-30, 30, (n, 3)).astype(np.float32)
    colour, free = rng.random((n, 3), np.float32), rng.random((n, 4), np.float32)
    value = albedo(np.full(n, material, np.uint8), p, colour, free, np.full(n, blur, np.float32))
    assert value.shape == (n, 3) and value.dtype == np.float32
    assert np.isfinite(value).all() and value.min() >= 0 and value.max() <= 0.95


def test_albedo_does_not_depend_on_its_neighbours():
    rng = np.random.default_rng(3)
    n = 500
    material = rng.integers(0, len(Material), n).astype(np.uint8)
    p = rng.uniform(-5, 5, (n, 3)).astype(np.float32)
    colour, free = rng.random((n, 3), np.float32), rng.random((n, 4), np.float32)
    blur = np.full(n, 0.02, np.float32)
    together = albedo(material, p, colour, free, blur)
    order = rng.permutation(n)
    np.testing.assert_array_equal(
        albedo(material[order], p[order], colour[order], free[order], blur[order]), together[order]
    )
