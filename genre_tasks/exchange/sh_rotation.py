"""Spherical harmonics of turned Gaussians: coefficients of degree 1 to 4 under a rotation.

Signs and order are those of 3DGS, as in ``genre_tasks.scene.spherical_harmonics``; degree 4 goes on in the same way.
"""

from __future__ import annotations

from functools import cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from genre_tasks.exchange.types import SH_REST_COUNTS
from genre_tasks.logs.types import Float32, Float64

MAX_SH_DEGREE = 4
"""Highest degree of harmonics that any format carries."""

_Real = TypeVar("_Real", Float32, Float64)
# The normalisation of each real harmonic, in the order in which they are used.
_C1 = np.sqrt(3 / (4 * np.pi))
_C2 = (np.sqrt(15 / np.pi) / 2, np.sqrt(5 / np.pi) / 4, np.sqrt(15 / np.pi) / 4)
_C3 = tuple(np.sqrt(c / np.pi) / 4 for c in (35 / 2, 420, 21 / 2, 7, 105))
_C4 = tuple(np.sqrt(c / np.pi) * 3 / 16 for c in (560, 280, 80, 40, 1, 20, 280, 35))
_DIRECTIONS = 96
# Entries nearer to −1, 0 or 1 are these values: far below float32, and far above the rounding of a 9 × 9 solve.
_SNAP = 1e-13
_ROWS = 1 << 16


def evaluate_real_sh(directions: Float64, degree: int) -> Float64:
    """Evaluates the real spherical harmonics up to a degree, without the constant one.

    Args:
        directions: [..., 3] unit vectors.
        degree: 1 to 4.

    Returns:
        [..., K] float64; K is 3, 8, 15 or 24.

    >>> evaluate_real_sh(np.array([0.0, 0.0, 1.0]), 1).round(4).tolist()
    [-0.0, 0.4886, -0.0]
    """
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    xx = x * x
    yy = y * y
    zz = z * z
    out = [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
        a, b, c = _C2
        out += [a * x * y, -a * y * z, b * (2 * zz - xx - yy), -a * x * z, c * (xx - yy)]
    if degree > 2:
        out += _evaluate_degree_3(x, y, z)
    if degree > 3:
        out += _evaluate_degree_4(x, y, z)
    return np.stack(out, -1)


def _evaluate_degree_3(x: Float64, y: Float64, z: Float64) -> list[Float64]:
    a, b, c, e, f = _C3
    xx = x * x
    yy = y * y
    zz = z * z
    return [
        -a * y * (3 * xx - yy),
        b * x * y * z,
        -c * y * (4 * zz - xx - yy),
        e * z * (2 * zz - 3 * xx - 3 * yy),
        -c * x * (4 * zz - xx - yy),
        f * z * (xx - yy),
        -a * x * (xx - 3 * yy),
    ]


def _evaluate_degree_4(x: Float64, y: Float64, z: Float64) -> list[Float64]:
    a, b, c, e, f, g, h, k = _C4
    xx = x * x
    yy = y * y
    zz = z * z
    return [
        a * x * y * (xx - yy),
        -b * y * z * (3 * xx - yy),
        c * x * y * (7 * zz - 1),
        -e * y * z * (7 * zz - 3),
        f * (zz * (35 * zz - 30) + 3),
        -e * x * z * (7 * zz - 3),
        g * (xx - yy) * (7 * zz - 1),
        -h * x * z * (xx - 3 * yy),
        k * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
    ]


def compute_sh_rotations(rotation: Float64, degree: int) -> tuple[Float64, ...]:
    """Computes the matrices that turn the coefficients of each degree.

    Args:
        rotation: [3, 3] orthogonal; a reflection is one too.
        degree: 0 to 4.

    Returns:
        One matrix [2 l + 1, 2 l + 1] for each degree l from 1 on. Where axes are only flipped or swapped, entries that
        should be −1, 0 or 1 are exactly these.

    >>> half_turn_about_z = np.diag([-1.0, -1.0, 1.0])
    >>> np.diag(compute_sh_rotations(half_turn_about_z, 1)[0]).tolist()
    [-1.0, 1.0, -1.0]
    """
    if not degree:
        return ()
    directions, inverses = _sample_directions()
    # The turned function at d is the original at Rᵀ d, so its coefficients are those of the basis at Rᵀ d.
    turned = evaluate_real_sh(directions @ np.asarray(rotation, np.float64), degree)
    matrices = []
    for band, inverse in enumerate(inverses[:degree], start=1):
        matrix = inverse @ turned[:, _columns(band)]
        nearest = np.round(matrix)
        # Rounding would leave traces of other harmonics, and a flip of axes would not invert itself.
        matrices.append(np.where(np.abs(matrix - nearest) < _SNAP, nearest + 0.0, matrix))
    return tuple(matrices)


def rotate_sh(sh_rest: _Real, rotation: Float64) -> _Real:
    """Turns the harmonics of Gaussians that are all turned by one rotation.

    The colour that was seen along d is then seen along R d.

    Args:
        sh_rest: [N, K, 3] coefficients without the constant one; K in ``SH_REST_COUNTS``.
        rotation: [3, 3] R, orthogonal; a reflection is one too.

    Returns:
        [N, K, 3] of the same type.

    >>> red_ahead = np.array([[[0, 0, 0], [0, 0, 0], [-1, 0, 0]]], np.float32)
    >>> left = rotate_sh(red_ahead, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    >>> left[0, :, 0].tolist()
    [-1.0, 0.0, 0.0]
    """
    matrices = compute_sh_rotations(rotation, SH_REST_COUNTS.index(sh_rest.shape[1]))
    out = np.empty_like(sh_rest)
    for band, matrix in enumerate(matrices, start=1):
        columns = _columns(band)
        diagonal = np.diag(matrix)
        # Flipped axes change signs alone, which most formats need and no product is needed for.
        if np.array_equal(matrix, np.diag(diagonal)):
            np.multiply(sh_rest[:, columns], diagonal[:, None], out=out[:, columns], casting="same_kind")
            continue
        # In blocks, so that no copy of all coefficients in float64 is made.
        for start in range(0, len(sh_rest), _ROWS):
            rows = slice(start, start + _ROWS)
            block = sh_rest[rows, columns].astype(np.float64)
            out[rows, columns] = np.einsum("ij,njc->nic", matrix, block, optimize=True)
    return out


def _columns(degree: int) -> slice:
    """Where the coefficients of one degree are."""
    return slice(degree**2 - 1, (degree + 1) ** 2 - 1)


@cache
def _sample_directions() -> tuple[Float64, tuple[NDArray[np.floating], ...]]:
    """Directions [D, 3], and for each degree the matrix from values there to coefficients."""
    n = np.arange(_DIRECTIONS) + 0.5
    z = 1 - 2 * n / _DIRECTIONS
    azimuth = np.pi * (1 + 5**0.5) * n
    horizontal = np.sqrt(1 - z * z)
    directions = np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), z], 1)
    basis = evaluate_real_sh(directions, MAX_SH_DEGREE)
    # Far more directions than harmonics, spread evenly: each solve is well conditioned.
    return directions, tuple(np.linalg.pinv(basis[:, _columns(band)]) for band in range(1, MAX_SH_DEGREE + 1))
