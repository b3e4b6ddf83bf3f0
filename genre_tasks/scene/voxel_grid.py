"""Voxels whose size grows with the distance from the path, in octaves; exact integer keys, deterministic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Float64

OCTAVE_M = 8.0
"""Up to twice this distance voxels have their base size; it doubles there and at each doubling after."""

MIN_VOXEL_M = 0.02
_HALF = 1 << 18
_BITS = 19
"""Voxel indices are packed in 19 bits each, octaves in 6: ± 5.2 km at the smallest voxel."""


@dataclass(frozen=True)
class Voxels:
    """P points grouped by voxel.

    Attributes:
        voxel_of: [P] the voxel of each point, in 0 … ``count`` − 1, ordered by position.
        count: of voxels that hold a point.
    """

    voxel_of: NDArray[np.int64]
    count: int

    def mean(self, values: NDArray, weights: NDArray | None = None) -> Float64:
        """Averages values over the points of each voxel.

        Args:
            values: [P, C].
            weights: [P]; ``None``: all points count the same.

        Returns:
            [count, C]; 0 where the weights sum to 0.

        >>> Voxels(np.array([0, 0, 1]), 2).mean(np.array([[1.0], [3.0], [5.0]])).tolist()
        [[2.0], [5.0]]
        """
        total = np.bincount(self.voxel_of, weights, self.count).astype(np.float64)
        columns = [
            np.bincount(self.voxel_of, v if weights is None else v * weights, self.count)
            for v in np.asarray(values, np.float64).T
        ]
        # Voxels without weight have a sum of zero, which the floor leaves at zero.
        return np.stack(columns, 1) / np.maximum(total, 1e-12)[:, None]


def distance_octaves(distance_m: NDArray) -> NDArray[np.int64]:
    """Gives the octave of each distance, by which voxels double in size: 0 up to 16 m, 1 up to 32 m, and so on.

    >>> distance_octaves(np.array([3.0, 20.0, 40.0])).tolist()
    [0, 1, 2]
    """
    # The floor keeps the vehicle's own position, at distance zero, out of the logarithm.
    return np.floor(np.log2(np.maximum(distance_m, OCTAVE_M) / OCTAVE_M)).astype(np.int64)


def voxel_keys(points: Float32, octave: NDArray[np.int64], size_m: float) -> NDArray[np.int64]:
    """Computes a key for each point's voxel; exact, so that grouping does not depend on rounding.

    Args:
        points: [P, 3] metres.
        octave: [P]; the voxel's size is ``size_m · 2**octave``.
        size_m: of a voxel in octave 0.

    Returns:
        [P] the octave and the integer voxel coordinates, packed in one number.
    """
    cell = np.floor(points / (size_m * np.exp2(octave))[:, None]).astype(np.int64) + _HALF
    # Farther points share the outermost voxels, rather than wrapping around into others.
    cell = cell.clip(0, 2 * _HALF - 1)
    return (((octave << _BITS | cell[:, 0]) << _BITS) | cell[:, 1]) << _BITS | cell[:, 2]


def group_by_voxel(points: Float32, octave: NDArray[np.int64], size_m: float) -> Voxels:
    """Groups points by the voxel that they lie in.

    Args:
        points: [P, 3] metres.
        octave: [P], see :func:`voxel_keys`.
        size_m: of a voxel in octave 0.

    >>> group_by_voxel(np.array([[0.1, 0, 0], [0.2, 0, 0], [1.5, 0, 0]]), np.zeros(3, np.int64), 1.0).count
    2
    """
    unique, voxel_of = np.unique(voxel_keys(points, octave, size_m), return_inverse=True)
    return Voxels(voxel_of, len(unique))


def count_voxels(points: Float32, octave: NDArray[np.int64], size_m: float) -> int:
    """Counts the voxels that points fill, faster than by grouping them.

    Args:
        points: [P, 3] metres.
        octave: [P], see :func:`voxel_keys`.
        size_m: of a voxel in octave 0.
    """
    if not len(points):
        return 0
    # Sorted and compared with their neighbours: np.unique would also copy the distinct keys.
    keys = np.sort(voxel_keys(points, octave, size_m))
    return 1 + int(np.count_nonzero(np.diff(keys)))


def find_voxel_size(points: Float32, octave: NDArray[np.int64], max_count: int, max_size_m: float = 4.0) -> float:
    """Finds the smallest voxel size at which points fill a limited number of voxels.

    Args:
        points: [P, 3] metres.
        octave: [P], see :func:`voxel_keys`.
        max_count: of voxels.
        max_size_m: where the search starts; it goes beyond if even that fills too many.

    Returns:
        Size in metres of a voxel in octave 0, at least ``MIN_VOXEL_M``, to 2 %. Points about the origin fill up to
        eight voxels of any size in each octave: where these are too many, the size is that of the points' extent.
    """
    low = MIN_VOXEL_M
    high = max_size_m
    if count_voxels(points, octave, low) <= max_count:
        return low
    # A size that is large enough must be known before the interval can be halved.
    extent = float(np.abs(points).max(initial=0.0))
    while count_voxels(points, octave, high) > max_count:
        # Larger voxels would hold the same points, however large they are.
        if high > extent:
            return high
        high *= 2
    while high / low > 1.02:
        # Halved on a logarithmic scale: the result is to be exact in relation to its size.
        middle = (low * high) ** 0.5
        if count_voxels(points, octave, middle) > max_count:
            low = middle
        else:
            high = middle
    return high
