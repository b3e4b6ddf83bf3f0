"""Spherical harmonics under rotations: values, signs and inverses."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from genre_tasks.exchange.sh_rotation import compute_sh_rotations, evaluate_real_sh, rotate_sh
from genre_tasks.exchange.types import SH_REST_COUNTS
from genre_tasks.scene.spherical_harmonics import evaluate_sh_basis

DEGREES = (1, 2, 3, 4)


def directions(count: int = 200) -> np.ndarray:
    drawn = np.random.default_rng(1).normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def coefficients(degree: int, count: int = 5) -> np.ndarray:
    return np.random.default_rng(degree).normal(size=(count, SH_REST_COUNTS[degree], 3))


def flips() -> list[np.ndarray]:
    """All matrices that only flip and swap axes."""
    signs = itertools.product((1.0, -1.0), repeat=3)
    return [np.diag(s)[list(order)] for s in signs for order in itertools.permutations(range(3))]


def test_the_basis_is_that_of_the_renderer() -> None:
    at = torch.from_numpy(directions())
    for degree in (1, 2, 3):
        expected = torch.stack(evaluate_sh_basis(at, SH_REST_COUNTS[degree]), 1)
        np.testing.assert_allclose(evaluate_real_sh(at.numpy(), degree), expected.numpy(), atol=1e-14)


def test_the_basis_is_that_of_scipy() -> None:
    at = directions()
    theta = np.arccos(at[:, 2])
    phi = np.arctan2(at[:, 1], at[:, 0])
    columns = []
    for degree in DEGREES:
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), theta, phi)
            part = value.imag if order < 0 else value.real
            columns.append(part * (2**0.5 if order else 1))
    np.testing.assert_allclose(evaluate_real_sh(at, 4), np.stack(columns, 1), atol=1e-13)


@pytest.mark.parametrize("degree", DEGREES)
def test_the_turned_function_is_the_function_at_turned_directions(degree: int) -> None:
    at = directions()
    given = coefficients(degree)
    before = np.einsum("dk,nkc->dnc", evaluate_real_sh(at, degree), given)
    for rotation in (*Rotation.random(20, random_state=3).as_matrix(), *flips()):
        turned = rotate_sh(given, rotation)
        after = np.einsum("dk,nkc->dnc", evaluate_real_sh(at @ rotation.T, degree), turned)
        np.testing.assert_allclose(after, before, atol=1e-10)


@pytest.mark.parametrize("degree", DEGREES)
def test_rotations_compose(degree: int) -> None:
    first, second = Rotation.random(2, random_state=7).as_matrix()
    given = coefficients(degree)
    np.testing.assert_allclose(rotate_sh(rotate_sh(given, first), second), rotate_sh(given, second @ first), atol=1e-12)


@pytest.mark.parametrize("signs", list(itertools.product((1.0, -1.0), repeat=3)))
def test_flips_of_axes_change_signs_alone(signs: tuple[float, ...]) -> None:
    given = coefficients(4).astype(np.float32)
    flip = np.diag(signs)
    for matrix in compute_sh_rotations(flip, 4):
        assert np.array_equal(np.abs(matrix), np.eye(len(matrix)))
    turned = rotate_sh(given, flip)
    assert np.array_equal(np.abs(turned), np.abs(given))
    assert np.array_equal(rotate_sh(turned, flip), given)


def test_swaps_of_axes_leave_no_traces() -> None:
    for matrix in flips():
        for band in compute_sh_rotations(matrix, 4):
            assert not ((np.abs(band) > 0) & (np.abs(band) < 0.1)).any()


def test_many_rows_are_turned_as_few() -> None:
    rotation = Rotation.random(random_state=2).as_matrix()
    many = np.random.default_rng(0).normal(size=(70_000, 3, 3)).astype(np.float32)
    assert np.array_equal(rotate_sh(many, rotation)[-50:], rotate_sh(many[-50:], rotation))


def test_no_harmonics() -> None:
    assert rotate_sh(np.zeros((4, 0, 3), np.float32), np.eye(3)).shape == (4, 0, 3)
