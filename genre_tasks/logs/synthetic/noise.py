"""Value noise and per-cell random numbers from one fixed table: the same on every machine and in every order."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Real numbers of either precision; float32 in practice.
Reals = NDArray[np.floating[Any]]

_SIZE = 256
_TABLE = np.random.default_rng(20250301).random(_SIZE * _SIZE, np.float32)


def cell(i: NDArray, j: NDArray | int, stream: int = 0) -> Reals:
    """A random number in [0, 1) for each integer cell (i, j); ``stream`` gives independent ones."""
    a = (np.asarray(i).astype(np.int32) + np.int32(stream * 37 & 255)) & 255
    b = (np.asarray(j).astype(np.int32) + np.int32(stream * 91 & 255)) & 255
    return _TABLE[a * _SIZE + b]


def dot3(a: Reals, b: Reals) -> Reals:
    """[n] products of [n, 3] rows, summed in fixed order (numpy's reduction over three is ten times as slow)."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def rotated(rotation: Reals, vectors: Reals) -> Reals:
    """``rotation`` [3, 3] times each row of ``vectors`` [n, 3]; no BLAS, so the same bytes at any thread count."""
    return np.stack([dot3(vectors, rotation[i]) for i in range(3)], -1)


def noise(x: Reals, y: Reals, stream: int = 0) -> Reals:
    """Smooth value noise in [0, 1], one feature a unit."""
    i, j = np.floor(x), np.floor(y)
    u, v = x - i, y - j
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    a = (i.astype(np.int32) + np.int32(stream * 37 & 255)) & 255
    b = (j.astype(np.int32) + np.int32(stream * 91 & 255)) & 255
    a1, b1 = ((a + 1) & 255) * _SIZE, (b + 1) & 255
    a *= _SIZE
    low = _TABLE[a + b] * (1 - u) + _TABLE[a1 + b] * u
    high = _TABLE[a + b1] * (1 - u) + _TABLE[a1 + b1] * u
    return low * (1 - v) + high * v


def fractal(x: Reals, y: Reals, octaves: int, stream: int = 0) -> Reals:
    """Octaves of noise, each half as strong and about twice as fine; in [0, 1]."""
    total, weight, amount = np.zeros_like(x), 0.0, 1.0
    for k in range(octaves):
        total += np.float32(amount) * noise(x, y, stream + k)
        weight += amount
        amount *= 0.5
        x, y = x * np.float32(2.03), y * np.float32(2.03)
    return total / np.float32(weight)


def stripe(x: Reals, centre: float, width: float, blur: Reals) -> Reals:
    """1 on a line of that width, 0 beside it, box-filtered over ``blur``."""
    return np.clip((width / 2 - np.abs(x - np.float32(centre))) / np.maximum(blur, 1e-4) + 0.5, 0, 1)


def seam(x: Reals, period: float, width: float, blur: Reals) -> Reals:
    """A periodic ``stripe`` (joints between bricks or slabs), fading to its mean where the blur exceeds the period."""
    away = np.abs(x - np.float32(period) * np.round(x / np.float32(period)))
    sharp = np.clip((width / 2 - away) / np.maximum(blur, 1e-4) + 0.5, 0, 1)
    keep = np.clip(2 - 2 * blur / np.float32(period), 0, 1)
    return sharp * keep + np.float32(width / period) * (1 - keep)
