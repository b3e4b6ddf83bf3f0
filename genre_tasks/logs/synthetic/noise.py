"""Value noise and per-cell random numbers from one fixed table: the same on every machine and in every order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32

_SIZE = 256
_TABLE = np.random.default_rng(20250301).random(_SIZE * _SIZE, np.float32)


def cell(i: NDArray, j: NDArray | int, stream: int = 0) -> Float32:
    """A random number in [0, 1) for each integer cell (i, j); ``stream`` gives independent ones."""
    a = (np.asarray(i).astype(np.int32) + np.int32(stream * 37 & 255)) & 255
    b = (np.asarray(j).astype(np.int32) + np.int32(stream * 91 & 255)) & 255
    return _TABLE[a * _SIZE + b]


def noise(x: Float32, y: Float32, stream: int = 0) -> Float32:
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


def fractal(x: Float32, y: Float32, octaves: int, stream: int = 0) -> Float32:
    """Octaves of noise, each half as strong and about twice as fine; in [0, 1]."""
    total, weight, amount = np.zeros_like(x), 0.0, 1.0
    for k in range(octaves):
        total += np.float32(amount) * noise(x, y, stream + k)
        weight += amount
        amount *= 0.5
        x, y = x * np.float32(2.03), y * np.float32(2.03)
    return total / np.float32(weight)


def stripe(x: Float32, centre: float, width: float, blur: Float32) -> Float32:
    """1 on a line of that width, 0 beside it, box-filtered over ``blur``."""
    return np.clip((width / 2 - np.abs(x - np.float32(centre))) / np.maximum(blur, 1e-4) + 0.5, 0, 1)


def seam(x: Float32, period: float, width: float, blur: Float32) -> Float32:
    """A periodic ``stripe`` (joints between bricks or slabs), fading to its mean where the blur exceeds the period."""
    away = np.abs(x - np.float32(period) * np.round(x / np.float32(period)))
    sharp = np.clip((width / 2 - away) / np.maximum(blur, 1e-4) + 0.5, 0, 1)
    keep = np.clip(2 - 2 * blur / np.float32(period), 0, 1)
    return sharp * keep + np.float32(width / period) * (1 - keep)
