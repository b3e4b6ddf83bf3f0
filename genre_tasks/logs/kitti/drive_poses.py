"""The path of a KITTI drive, from its inertial navigation: where the vehicle was at any time.

Latitude and longitude become metres by a Mercator projection with the scale of the first latitude, as in KITTI's own
development kit. The world has x to the east, y to the north and z up, with its origin at the first frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import Float64

_EARTH_RADIUS_M = 6378137.0


class DrivePoses:
    """Poses between those that were recorded.

    Args:
        times_s: [F] increasing seconds, at least two.
        records: [F, 6] latitude and longitude in degrees, altitude in metres, roll, pitch and yaw in radians.
    """

    def __init__(self, times_s: Float64, records: Float64) -> None:
        latitude, longitude, altitude = records[:, :3].T
        # One scale for the drive, so that distances along it are metres.
        scale = np.cos(np.radians(latitude[0])) * _EARTH_RADIUS_M
        east = scale * np.radians(longitude)
        north = scale * np.log(np.tan(np.radians(90.0 + latitude) / 2))
        positions = np.stack([east, north, altitude], axis=1)
        self._times = times_s
        # Nearby: differences of such numbers keep the nanometres, but files of others may not.
        self._positions = positions - positions[0]
        self._rotations = Rotation.from_euler("ZYX", records[:, [5, 4, 3]])

    def at(self, times_s: Float64 | Sequence[float]) -> tuple[Rotation, Float64]:
        """Finds poses of the inertial unit; before the first and after the last record it goes on as it went.

        Args:
            times_s: [N] seconds.

        Returns:
            [N] rotations and [N, 3] positions: world_SE3_imu.
        """
        wanted = np.asarray(times_s, dtype=np.float64)
        after = np.clip(np.searchsorted(self._times, wanted, side="right"), 1, len(self._times) - 1)
        start, end = self._times[after - 1], self._times[after]
        part = (wanted - start) / (end - start)
        positions = self._positions[after - 1] + part[:, None] * (self._positions[after] - self._positions[after - 1])
        # Also outside of the records: a sensor fires a few milliseconds before or after them.
        # By the shortest turn, at a constant rate.
        turns = self._rotations[after - 1].inv() * self._rotations[after]
        rotations = self._rotations[after - 1] * Rotation.from_rotvec(part[:, None] * turns.as_rotvec())
        return rotations, positions

    def matrix_at(self, time_s: float) -> Float64:
        """Finds one pose.

        Args:
            time_s: seconds.

        Returns:
            [4, 4] world_SE3_imu.
        """
        rotations, positions = self.at([time_s])
        pose = np.eye(4)
        pose[:3, :3] = rotations.as_matrix()[0]
        pose[:3, 3] = positions[0]
        return pose
