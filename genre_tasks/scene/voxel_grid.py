"""Voxels whose size grows with the distance from the path, in octaves; exact integer keys, deterministic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Float64

OCTAVE_M = 8.0
"""Up to twice this distance voxels have their base size; it doubles there and at each doubling after."""

MIN_VOXEL_M = 0.02
_HALF, _BITS = 1 << 18, 19
"""Voxel indices are packed in 19 bits each, levels in 6: ± 5.2 km at the smallest voxel."""


@dataclass(frozen=True)
class Voxels:
    """``which`` [P] voxel of each point, in 0 … ``count`` − 1, ordered by position."""

    which: NDArray[np.int64]
    count: int

    def mean(self, values: NDArray, weights: NDArray | None = None) -> Float64:
        """Weighted mean [count, C] of per-point values [P, C]; 0 where the weights sum to 0."""
        total = np.bincount(self.which, weights, self.count).astype(np.float64)
        columns = [
            np.bincount(self.which, v if weights is None else v * weights, self.count)
            for v in np.asarray(values, np.float64).T
        ]
        return np.stack(columns, 1) / np.maximum(total, 1e-12)[:, None]


def levels(distance_m: NDArray) -> NDArray[np.int64]:
    """Octave of each distance: 0 up to 16 m, 1 up to 32 m, …"""
    return np.floor(np.log2(np.maximum(distance_m, OCTAVE_M) / OCTAVE_M)).astype(np.int64)


def voxel_keys(points: Float32, level: NDArray[np.int64], size_m: float) -> NDArray[np.int64]:
    """One exact int64 per point: its level and the integer voxel coordinates at ``size_m · 2**level``."""
    cell = np.floor(points / (size_m * np.exp2(level))[:, None]).astype(np.int64) + _HALF
    cell = cell.clip(0, 2 * _HALF - 1)
    return (((level << _BITS | cell[:, 0]) << _BITS) | cell[:, 1]) << _BITS | cell[:, 2]


def group(points: Float32, level: NDArray[np.int64], size_m: float) -> Voxels:
    """Points grouped by voxel."""
    unique, which = np.unique(voxel_keys(points, level, size_m), return_inverse=True)
    return Voxels(which, len(unique))


def count_voxels(points: Float32, level: NDArray[np.int64], size_m: float) -> int:
    """How many voxels the points fill."""
    if not len(points):
        return 0
    keys = np.sort(voxel_keys(points, level, size_m))
    return 1 + int(np.count_nonzero(np.diff(keys)))


def voxel_size_for(points: Float32, level: NDArray[np.int64], max_count: int, max_size_m: float = 4.0) -> float:
    """The smallest voxel size in [2 cm, ``max_size_m``] (to 2 %) that fills at most ``max_count`` voxels."""
    low, high = MIN_VOXEL_M, max_size_m
    if count_voxels(points, level, low) <= max_count:
        return low
    while count_voxels(points, level, high) > max_count:
        high *= 2
    while high / low > 1.02:
        middle = (low * high) ** 0.5
        if count_voxels(points, level, middle) > max_count:
            low = middle
        else:
            high = middle
    return high
