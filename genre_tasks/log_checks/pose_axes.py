"""Whether the rotations of poses are read as they were written: the order of quaternions, and their direction."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.log_checks.pose_conventions import find_rigid, reread_rotations
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Float64

# Over a shorter way, noise of positions turns the direction of travel.
_CHORD_M = 2.0
# A vehicle drives where it points, or backwards; slip and mounting account for a few degrees.
_MAX_HEADING_DEG = 25.0
# The steepest roads have 20°.
_MAX_TILT_DEG = 25.0
# Another reading has to fit well, as chance makes one of eight fit a little.
_GOOD_HEADING_DEG = 10.0
_GOOD_TILT_DEG = 12.0
_REMEDY = "Write poses as sensor to world, with quaternions as w, x, y, z."


def find_misread_poses(sample: LogSample) -> Iterator[Finding]:
    """Finds poses whose axes do not fit the way that the vehicle drives, and fit it when read in another way.

    Args:
        sample: the frames of a chunk.

    Yields:
        ``misread_poses`` with the reading that fits; nothing where none does, as motion and tilt are judged elsewhere.
    """
    poses = sample.world_SE3_lidar[find_rigid(sample.world_SE3_lidar)]
    if not len(poses):
        return
    heading_deg = measure_heading_deg(poses)
    tilt_deg = _measure_tilt_deg(poses)
    # A vehicle may drive backwards for a chunk, but not sideways. NaN is no verdict.
    is_sideways = _MAX_HEADING_DEG < heading_deg < 180 - _MAX_HEADING_DEG
    if not is_sideways and tilt_deg <= _MAX_TILT_DEG:
        return
    for reading in reread_rotations(poses):
        other_heading_deg = measure_heading_deg(reading.world_SE3_lidar)
        other_tilt_deg = _measure_tilt_deg(reading.world_SE3_lidar)
        if other_heading_deg < _GOOD_HEADING_DEG and other_tilt_deg < _GOOD_TILT_DEG:
            message = (
                f"the poses point {heading_deg:.0f}° away from the direction of travel and are tilted by "
                f"{tilt_deg:.0f}°; they fit ({other_heading_deg:.0f}° and {other_tilt_deg:.0f}°) with {reading.name}"
            )
            numbers = {"heading_deg": heading_deg, "tilt_deg": tilt_deg, "limit_deg": _MAX_HEADING_DEG}
            yield Finding("misread_poses", "warning", message, _REMEDY, numbers)
            return


def measure_heading_deg(world_SE3_lidar: Float64) -> float:
    """Measures the angle between the x axis of poses and the direction of travel.

    Args:
        world_SE3_lidar: [F, 4, 4] finite poses.

    Returns:
        Median in degrees, 0 to 180; NaN where the vehicle stands.

    >>> poses = np.tile(np.eye(4), (3, 1, 1))
    >>> poses[:, 1, 3] = [0.0, 5.0, 10.0]
    >>> measure_heading_deg(poses)
    90.0
    """
    positions = world_SE3_lidar[:, :3, 3]
    angles = []
    for start in range(len(positions)):
        offset = positions[start + 1 :] - positions[start]
        is_far = np.linalg.norm(offset, axis=1) > _CHORD_M
        if not is_far.any():
            continue
        end = int(np.argmax(is_far))
        forward = world_SE3_lidar[start, :3, 0] + world_SE3_lidar[start + 1 + end, :3, 0]
        angles.append(_angle_deg(forward, offset[end]))
    return float(np.median(angles)) if angles else np.nan


def _measure_tilt_deg(poses: Float64) -> float:
    """Median angle in degrees between the z axis of poses and that of the world."""
    return float(np.median(np.rad2deg(np.arccos(np.clip(poses[:, 2, 2], -1, 1)))))


def _angle_deg(a: Float64, b: Float64) -> float:
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
