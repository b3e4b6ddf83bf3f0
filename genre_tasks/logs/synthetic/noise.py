"""Value noise and per-cell random numbers from one fixed table: the same on every machine and in every order.

Coordinates are float32 in practice: textures are evaluated at millions of points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Real numbers of either precision.
Reals = NDArray[np.floating[Any]]

_SIZE = 256
# A table, not a hash of coordinates: a look-up is faster, and its 256 KiB stay in the processor's cache.
_TABLE = np.random.default_rng(20250301).random(_SIZE * _SIZE, np.float32)
# Not quite 2, so that the lattices of two octaves do not coincide.
_OCTAVE_SCALE = np.float32(2.03)
_MIN_BLUR = 1e-4


def lattice_random(i: NDArray, j: NDArray | int, stream: int = 0) -> Reals:
    """Looks up a random number for each integer lattice point, such as one per brick.

    Args:
        i: [n] whole numbers, of any dtype; the table repeats every 256.
        j: [n], or one number.
        stream: streams are independent of each other.

    Returns:
        [n] float32 in [0, 1).
    """
    # The factors are odd, so that each of 256 streams reads the table from another place.
    row = _shift(np.asarray(i), stream * 37)
    column = _shift(np.asarray(j), stream * 91)
    return _TABLE[row * _SIZE + column]


def value_noise(x: Reals, y: Reals, stream: int = 0) -> Reals:
    """Interpolates the random numbers of a lattice of step 1: smooth spots, one to a unit.

    Args:
        x: [n] coordinates, in units of the wanted feature size.
        y: [n].
        stream: streams are independent of each other.

    Returns:
        [n] in [0, 1].

    >>> value_noise(np.zeros(1, np.float32), np.zeros(1, np.float32)) == lattice_random(np.zeros(1), 0)
    array([ True])
    """
    i = np.floor(x)
    j = np.floor(y)
    u = x - i
    v = y - j
    # Smoothstep: the slope is 0 at lattice points, where four cells meet.
    u = u * u * (3 - 2 * u)
    v = v * v * (3 - 2 * v)
    row = _shift(i, stream * 37)
    column = _shift(j, stream * 91)
    next_row = ((row + 1) & 255) * _SIZE
    next_column = (column + 1) & 255
    # In place, which saves a pass over the points of an image.
    row *= _SIZE
    low = _TABLE[row + column] * (1 - u) + _TABLE[next_row + column] * u
    high = _TABLE[row + next_column] * (1 - u) + _TABLE[next_row + next_column] * u
    return low * (1 - v) + high * v


def _shift(values: NDArray, offset: int) -> NDArray[np.int32]:
    # The mask wraps negative numbers too, where a remainder would need a branch.
    return (values.astype(np.int32) + np.int32(offset & 255)) & 255


def fractal_noise(x: Reals, y: Reals, octaves: int, stream: int = 0) -> Reals:
    """Sums octaves of value noise, each half as strong and about twice as fine as the one before.

    Args:
        x: [n] coordinates, in units of the coarsest feature.
        y: [n].
        octaves: how many, at least 1.
        stream: of the first octave; the others take the following ones.

    Returns:
        [n] in [0, 1].
    """
    # Float32 weights throughout, or numpy would turn millions of points into float64.
    total = np.zeros_like(x)
    total_weight = 0.0
    weight = 1.0
    for octave in range(octaves):
        total += np.float32(weight) * value_noise(x, y, stream + octave)
        total_weight += weight
        weight *= 0.5
        x = x * _OCTAVE_SCALE
        y = y * _OCTAVE_SCALE
    return total / np.float32(total_weight)


def stripe(x: Reals, centre: float, width: float, blur: Reals) -> Reals:
    """Draws a line across x, box-filtered so that it does not flicker far away.

    Args:
        x: [n] metres.
        centre: where the line is.
        width: of the line, metres.
        blur: [n] footprint of a ray, metres.

    Returns:
        [n] share of the footprint that the line covers: 1 on it, 0 away from it.

    >>> stripe(np.array([0.0, 1.0, 1.05]), 1.0, 0.1, np.full(3, 0.01))
    array([0. , 1. , 0.5])
    """
    return np.clip((width / 2 - np.abs(x - np.float32(centre))) / np.maximum(blur, _MIN_BLUR) + 0.5, 0, 1)


def periodic_stripes(x: Reals, period: float, width: float, blur: Reals) -> Reals:
    """Draws a ``stripe`` at every multiple of a period, such as the joints between bricks.

    Args:
        x: [n] metres.
        period: distance between stripes, metres.
        width: of a stripe, metres.
        blur: [n] footprint of a ray, metres.

    Returns:
        [n] share of the footprint that stripes cover, fading to their mean where the footprint exceeds the period.
    """
    # Measured to the nearest stripe; the box filter sees only that one, which is why far stripes fade to their mean.
    distance = np.abs(x - np.float32(period) * np.round(x / np.float32(period)))
    sharp = np.clip((width / 2 - distance) / np.maximum(blur, _MIN_BLUR) + 0.5, 0, 1)
    weight = np.clip(2 - 2 * blur / np.float32(period), 0, 1)
    return sharp * weight + np.float32(width / period) * (1 - weight)


def dot_rows(a: Reals, b: Reals) -> Reals:
    """Multiplies vectors row by row, summed in fixed order.

    Args:
        a: [..., 3].
        b: [..., 3].

    Returns:
        [...] scalar products.

    >>> dot_rows(np.array([[1.0, 2.0, 3.0]]), np.array([[4.0, 5.0, 6.0]]))
    array([32.])
    """
    # numpy's reduction over three is ten times as slow.
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def rotate(rotation: Reals, vectors: Reals) -> Reals:
    """Turns vectors, without BLAS, so that the bytes are the same at any number of threads.

    Args:
        rotation: [3, 3].
        vectors: [n, 3].

    Returns:
        [n, 3] ``rotation`` times each row.
    """
    return np.stack([dot_rows(vectors, rotation[i]) for i in range(3)], -1)
