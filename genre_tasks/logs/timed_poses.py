"""Poses between those that were recorded, as sensors fire at times of their own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import Float64


class TimedPoses:
    """A path of poses.

    Args:
        times_s: [F] increasing seconds, at least two.
        rotations: [F].
        positions: [F, 3] metres.
    """

    def __init__(self, times_s: Float64, rotations: Rotation, positions: Float64) -> None:
        self._times = times_s
        self._rotations = rotations
        self._positions = positions

    def at(self, times_s: Float64 | Sequence[float]) -> tuple[Rotation, Float64]:
        """Finds poses; before the first and after the last record the path goes on as it went.

        Args:
            times_s: [N] seconds.

        Returns:
            [N] rotations and [N, 3] positions.
        """
        wanted = np.asarray(times_s, dtype=np.float64)
        after = np.clip(np.searchsorted(self._times, wanted, side="right"), 1, len(self._times) - 1)
        start, end = self._times[after - 1], self._times[after]
        part = (wanted - start) / (end - start)
        positions = self._positions[after - 1] + part[:, None] * (self._positions[after] - self._positions[after - 1])
        # By the shortest turn, at a constant rate. Also outside of the records: a sensor fires a few milliseconds
        # before or after them.
        turns = self._rotations[after - 1].inv() * self._rotations[after]
        rotations = self._rotations[after - 1] * Rotation.from_rotvec(part[:, None] * turns.as_rotvec())
        return rotations, positions

    def matrix_at(self, time_s: float) -> Float64:
        """Finds one pose.

        Args:
            time_s: seconds.

        Returns:
            [4, 4].
        """
        rotations, positions = self.at([time_s])
        pose = np.eye(4)
        pose[:3, :3] = rotations.as_matrix()[0]
        pose[:3, 3] = positions[0]
        return pose
