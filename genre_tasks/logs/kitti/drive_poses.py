"""The path of a KITTI drive, from its inertial navigation: where the vehicle was at any time.

Latitude and longitude become metres by a Mercator projection with the scale of the first latitude, as in KITTI's own
development kit. The world has x to the east, y to the north and z up, with its origin at the first frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.logs.timed_poses import POSE_REACH_S, TimedPoses
from genre_tasks.logs.types import Float64

_EARTH_RADIUS_M = 6378137.0


def project_records(times_s: Float64, records: Float64, **where: Any) -> TimedPoses:
    """Makes the path of the inertial unit from its records.

    Args:
        times_s: [F] increasing seconds, at least two.
        records: [F, 6] latitude and longitude in degrees, altitude in metres, roll, pitch and yaw in radians.
        where: file and log for errors, as ``InputError`` takes them.

    Returns:
        World_SE3_imu at any time near a record.
    """
    latitude, longitude, altitude = records[:, :3].T
    # One scale for the drive, so that distances along it are metres.
    scale = np.cos(np.radians(latitude[0])) * _EARTH_RADIUS_M
    east = scale * np.radians(longitude)
    north = scale * np.log(np.tan(np.radians(90.0 + latitude) / 2))
    positions = np.stack([east, north, altitude], axis=1)
    # Nearby: differences of such numbers keep the nanometres, but files of others may not.
    rotations = Rotation.from_euler("ZYX", records[:, [5, 4, 3]])
    return TimedPoses(times_s, rotations, positions - positions[0], POSE_REACH_S, **where)
