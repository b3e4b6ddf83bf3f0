"""Meshes, noise and textures of the synthetic street."""

import numpy as np
import pytest

from genre_tasks.logs.synthetic.camera_images import encode_srgb
from genre_tasks.logs.synthetic.materials import MIRROR, REFLECTIVITY, SHEEN, Material, SurfacePoints
from genre_tasks.logs.synthetic.mesh import Mesh, Surface, box_mesh, ellipsoid_mesh, join_meshes, tube_mesh
from genre_tasks.logs.synthetic.noise import (
    dot_rows,
    fractal_noise,
    lattice_random,
    periodic_stripes,
    rotate,
    stripe,
    value_noise,
)
from genre_tasks.logs.synthetic.textures import TEXTURES, evaluate_albedo
from genre_tasks.srgb import srgb_to_linear

GREY = Surface(0, (0.5, 0.5, 0.5))


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[:, k] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def volume(mesh: Mesh) -> float:
    """Of a star-shaped surface about the origin, whatever the faces' orientation."""
    a, b, c = (mesh.vertices[:, k] for k in range(3))
    return float(np.abs(np.einsum("ni,ni->n", a, np.cross(b, c))).sum() / 6)


def test_primitives_have_the_right_area_and_volume():
    box = box_mesh((-1, -1, -1), (1, 2, 3), GREY)
    assert len(box) == 12 and area(box) == pytest.approx(2 * (2 * 3 + 2 * 4 + 3 * 4))
    assert volume(box) == pytest.approx(24)
    ball = ellipsoid_mesh((0, 0, 0), (1, 1, 1), GREY, level=3)
    assert volume(ball) == pytest.approx(4 / 3 * np.pi, rel=0.02)
    can = tube_mesh([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], [1.0, 1.0], 64, GREY)
    assert volume(can) == pytest.approx(2 * np.pi, rel=0.01)


def test_a_transformed_mesh_keeps_its_texture():
    box = box_mesh((0, 0, 0), (1, 1, 1), GREY)
    pose = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1.0]])
    moved = box.transformed(pose)
    np.testing.assert_array_equal(moved.texture, box.texture)
    np.testing.assert_allclose(moved.vertices.reshape(-1, 3).min(0), [4, 6, 7])
    assert len(join_meshes([box, moved])) == 24 and len(join_meshes([])) == 0


def test_colour_space_round_trip():
    levels = np.arange(256)
    np.testing.assert_array_equal(encode_srgb(srgb_to_linear(levels / 255).astype(np.float32)), levels)


def test_noise_is_smooth_bounded_and_periodic():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-300, 300, (2, 5000)).astype(np.float32)
    value = value_noise(x, y)
    assert value.min() >= 0 and value.max() <= 1 and value.std() > 0.1
    assert np.abs(value_noise(x + np.float32(1e-3), y) - value).max() < 5e-3
    lattice = np.arange(-4, 4, dtype=np.float32)
    np.testing.assert_array_equal(value_noise(lattice, lattice), lattice_random(lattice, lattice))
    np.testing.assert_array_equal(lattice_random(lattice, lattice), lattice_random(lattice + 256, lattice - 256))
    assert np.abs(fractal_noise(x, y, 4) - fractal_noise(x, y, 4, stream=5)).mean() > 0.05


def test_lines_keep_their_mean_when_blurred():
    x = np.linspace(-6, 6, 24_001).astype(np.float32)
    for blur in (0.01, 0.1, 0.4, 3.0):
        assert periodic_stripes(x, 1.0, 0.2, np.full_like(x, blur)).mean() == pytest.approx(0.2, abs=0.03)
    line = stripe(x, 1.0, 0.5, np.full_like(x, 0.01))
    assert line[np.abs(x - 1) < 0.24].min() == 1 and line[np.abs(x - 1) > 0.26].max() == 0


def test_rotate_is_a_matrix_product():
    rng = np.random.default_rng(1)
    r, v = rng.normal(size=(3, 3)), rng.normal(size=(10, 3))
    np.testing.assert_allclose(rotate(r, v), v @ r.T)
    np.testing.assert_allclose(dot_rows(v, v), (v**2).sum(1))


def test_every_material_is_complete():
    assert set(TEXTURES) == set(Material)
    assert len(REFLECTIVITY) == len(MIRROR) == len(SHEEN) == len(Material)


def random_points(rng: np.random.Generator, count: int, reach: float, blur: float) -> SurfacePoints:
    return SurfacePoints(
        rng.uniform(-reach, reach, (count, 3)).astype(np.float32),
        rng.random((count, 3), np.float32),
        rng.random((count, 4), np.float32),
        np.full(count, blur, np.float32),
    )


@pytest.mark.parametrize("material", list(Material))
@pytest.mark.parametrize("blur", [1e-4, 0.05, 10.0])
def test_albedo_is_finite_and_bounded(material: Material, blur: float):
    count = 2000
    points = random_points(np.random.default_rng(2), count, 30, blur)
    value = evaluate_albedo(np.full(count, material, np.uint8), points)
    assert value.shape == (count, 3) and value.dtype == np.float32
    assert np.isfinite(value).all() and value.min() >= 0 and value.max() <= 0.95


def test_albedo_does_not_depend_on_its_neighbours():
    rng = np.random.default_rng(3)
    count = 500
    material = rng.integers(0, len(Material), count).astype(np.uint8)
    points = random_points(rng, count, 5, 0.02)
    together = evaluate_albedo(material, points)
    order = rng.permutation(count)
    np.testing.assert_array_equal(evaluate_albedo(material[order], points.select(order)), together[order])
