"""Poses between those that were recorded, as sensors fire at times of their own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64

POSE_REACH_S = 0.5
"""How far from a record of the vehicle's pose a sensor may fire: within a second a vehicle turns a corner."""


class TimedPoses:
    """A path of poses.

    Args:
        times_s: [F] increasing seconds, at least two.
        rotations: [F].
        positions: [F, 3] metres.
        reach_s: how many seconds from the nearest record a pose may be asked for; ``inf``: any number.
        where: file and log for the error, as ``InputError`` takes them.
    """

    def __init__(
        self, times_s: Float64, rotations: Rotation, positions: Float64, reach_s: float = math.inf, **where: Any
    ) -> None:
        self._times = times_s
        self._rotations = rotations
        self._positions = positions
        self._reach_s = reach_s
        self._where = where

    def at(self, times_s: Float64 | Sequence[float], frame: int | None = None) -> tuple[Rotation, Float64]:
        """Finds poses; before the first and after the last record the path goes on as it went.

        Args:
            times_s: [N] seconds.
            frame: that they are for, for the error.

        Returns:
            [N] rotations and [N, 3] positions.

        Raises:
            InputError: a time is farther from all records than ``reach_s``.
        """
        wanted = np.asarray(times_s, dtype=np.float64)
        self._require_near(wanted, frame)
        after = np.clip(np.searchsorted(self._times, wanted, side="right"), 1, len(self._times) - 1)
        start, end = self._times[after - 1], self._times[after]
        part = (wanted - start) / (end - start)
        positions = self._positions[after - 1] + part[:, None] * (self._positions[after] - self._positions[after - 1])
        # By the shortest turn, at a constant rate. Also outside of the records: a sensor fires a few milliseconds
        # before or after them.
        turns = self._rotations[after - 1].inv() * self._rotations[after]
        rotations = self._rotations[after - 1] * Rotation.from_rotvec(part[:, None] * turns.as_rotvec())
        return rotations, positions

    def _require_near(self, wanted: Float64, frame: int | None) -> None:
        after = np.clip(np.searchsorted(self._times, wanted), 1, len(self._times) - 1)
        distances = np.minimum(np.abs(wanted - self._times[after - 1]), np.abs(wanted - self._times[after]))
        # Between far records, and beyond the last one, a path is made up.
        if len(distances) and float(distances.max()) > self._reach_s:
            problem = f"the nearest recorded pose is {distances.max():.2f} s away, and {self._reach_s:g} s are allowed"
            remedy = "Correct the times, copy the poses again, or leave these frames out."
            raise InputError(problem, remedy=remedy, frame=frame, **self._where)

    def matrix_at(self, time_s: float, frame: int | None = None) -> Float64:
        """Finds one pose.

        Args:
            time_s: seconds.
            frame: that it is for, for the error.

        Returns:
            [4, 4].

        Raises:
            InputError: the time is farther from all records than ``reach_s``.
        """
        rotations, positions = self.at([time_s], frame)
        pose = np.eye(4)
        pose[:3, :3] = rotations.as_matrix()[0]
        pose[:3, 3] = positions[0]
        return pose
