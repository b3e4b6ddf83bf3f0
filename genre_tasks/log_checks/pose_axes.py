"""Whether the axes of poses are those of a vehicle and its cameras: ahead where it drives, up where the sky is."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.log_checks.pose_conventions import reread_rotations
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Camera, Float64
from genre_tasks.scene.transforms import invert_se3

# Over a shorter way, noise of positions turns the direction of travel.
_CHORD_M = 2.0
# A vehicle drives where it points, or backwards; slip and mounting account for a few degrees.
_MAX_HEADING_DEG = 25.0
# The steepest roads have 20°.
_MAX_TILT_DEG = 30.0
# A camera that looks down at the road next to a bus may tilt by so much; other axes differ by 90°.
_MAX_CAMERA_TILT_DEG = 75.0
# Cameras are mounted on the vehicle: their poses relative to it change by what the sensors' times differ.
_MAX_RIG_TURN_DEG = 5.0
_MAX_RIG_SHIFT_M = 1.0
_MAX_RIG_OFFSET_M = 20.0
_REMEDY = "Give poses as sensor to world, quaternions as w, x, y, z, axes as the reader's documentation says."


def find_odd_pose_axes(sample: LogSample) -> Iterator[Finding]:
    """Finds poses whose axes are not x forward, z up, or whose cameras do not move with the vehicle.

    Args:
        sample: the frames of a chunk.

    Yields:
        ``odd_heading``, ``odd_up_axis``, ``odd_camera_axes``, ``camera_off_vehicle`` or ``loose_camera``.
    """
    poses = sample.world_SE3_lidar
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    if len(poses):
        yield from _find_odd_vehicle_axes(poses)
    for camera in sample.cameras:
        yield from _find_odd_camera(sample, camera)


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
        distance_m = np.linalg.norm(offset, axis=1)
        if not (distance_m > _CHORD_M).any():
            continue
        end = int(np.argmax(distance_m > _CHORD_M))
        forward = world_SE3_lidar[start, :3, 0] + world_SE3_lidar[start + 1 + end, :3, 0]
        angles.append(_angle_deg(forward, offset[end]))
    return float(np.median(angles)) if angles else np.nan


def _measure_tilt_deg(poses: Float64) -> float:
    """Median angle in degrees between the z axis of poses and that of the world."""
    return float(np.median(np.rad2deg(np.arccos(np.clip(poses[:, 2, 2], -1, 1)))))


def _angle_deg(a: Float64, b: Float64) -> float:
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def _find_odd_vehicle_axes(poses: Float64) -> Iterator[Finding]:
    heading_deg = measure_heading_deg(poses)
    tilt_deg = _measure_tilt_deg(poses)
    # A vehicle may drive backwards for a chunk, but not sideways. NaN is no verdict.
    is_sideways = _MAX_HEADING_DEG < heading_deg < 180 - _MAX_HEADING_DEG
    if not is_sideways and tilt_deg <= _MAX_TILT_DEG:
        return
    cause = ""
    for reading in reread_rotations(poses):
        other_deg = measure_heading_deg(reading.world_SE3_lidar)
        fits = np.isnan(other_deg) or other_deg < _MAX_HEADING_DEG
        if fits and _measure_tilt_deg(reading.world_SE3_lidar) < _MAX_TILT_DEG:
            cause = f"; they fit better with {reading.name}"
            break
    if tilt_deg > _MAX_TILT_DEG:
        message = f"the vehicle's z axis points {tilt_deg:.0f}° away from the world's{cause}"
        numbers = {"tilt_deg": tilt_deg, "limit_deg": _MAX_TILT_DEG}
        yield Finding("odd_up_axis", "warning", message, _REMEDY, numbers)
    if is_sideways:
        message = f"the vehicle drives {heading_deg:.0f}° to the side of where its poses point{cause}"
        numbers = {"heading_deg": heading_deg, "limit_deg": _MAX_HEADING_DEG}
        yield Finding("odd_heading", "warning", message, _REMEDY, numbers)


def _find_odd_camera(sample: LogSample, camera: Camera) -> Iterator[Finding]:
    world_SE3_camera = sample.world_SE3_camera(camera)
    world_SE3_lidar = sample.world_SE3_lidar
    usable = np.isfinite(world_SE3_camera).all(axis=(1, 2)) & np.isfinite(world_SE3_lidar).all(axis=(1, 2))
    if not usable.any():
        return
    lidar_SE3_camera = invert_se3(world_SE3_lidar[usable]) @ world_SE3_camera[usable]
    frames = np.array(sample.frames)[usable]
    name = camera.name
    # The camera's y axis points down.
    tilts_deg = np.rad2deg(np.arccos(np.clip(-lidar_SE3_camera[:, 2, 1], -1, 1)))
    tilt_deg = float(np.median(tilts_deg))
    if tilt_deg > _MAX_CAMERA_TILT_DEG:
        message = f"{name}: the upper edge of the image points {tilt_deg:.0f}° away from the vehicle's z axis"
        remedy = "Give camera poses as camera to world with axes x right, y down, z forward."
        numbers = {"tilt_deg": tilt_deg, "limit_deg": _MAX_CAMERA_TILT_DEG}
        yield Finding("odd_camera_axes", "warning", message, remedy, numbers, name)
    positions = lidar_SE3_camera[:, :3, 3]
    offset_m = float(np.median(np.linalg.norm(positions, axis=1)))
    if offset_m > _MAX_RIG_OFFSET_M:
        message = f"{name} is {offset_m:.3g} m from the LiDAR's pose"
        numbers = {"offset_m": offset_m, "limit_m": _MAX_RIG_OFFSET_M}
        yield Finding("camera_off_vehicle", "warning", message, _REMEDY, numbers, name)
    shifts_m = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    # Camera and LiDAR have times of their own, between which the vehicle moves.
    allowed_m = _MAX_RIG_SHIFT_M + _measure_sensor_delay_m(sample, camera)[usable]
    turns_deg = _measure_turns_deg(lidar_SE3_camera[:, :3, :3])
    loose = (shifts_m > allowed_m) | (turns_deg > _MAX_RIG_TURN_DEG)
    if loose.any():
        numbers = {"shift_m": float(shifts_m.max()), "turn_deg": float(turns_deg.max())}
        message = (
            f"{name} does not move with the vehicle: its mounting shifts by {numbers['shift_m']:.2g} m "
            f"and turns by {numbers['turn_deg']:.2g}°"
        )
        numbers |= {"limit_m": _MAX_RIG_SHIFT_M, "limit_deg": _MAX_RIG_TURN_DEG}
        yield Finding("loose_camera", "warning", message, _REMEDY, numbers, name, tuple(map(int, frames[loose])))


def _measure_turns_deg(rotations: Float64) -> Float64:
    """[F] degrees by which rotations [F, 3, 3] differ from their mean."""
    u, _, vh = np.linalg.svd(rotations.mean(axis=0))
    # The nearest rotation to the mean: a mean of matrices is none.
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vh)]) @ vh
    traces = np.einsum("fij,ij->f", rotations, mean)
    return np.asarray(np.rad2deg(np.arccos(np.clip((traces - 1) / 2, -1, 1))), dtype=np.float64)


def _measure_sensor_delay_m(sample: LogSample, camera: Camera) -> Float64:
    """[F] metres that the vehicle drives between the time of a sweep and that of an image."""
    positions = sample.world_SE3_lidar[:, :3, 3]
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    periods_s = np.abs(np.diff(sample.times_s))
    usable = np.isfinite(steps_m) & (periods_s > 0)
    speed_m_s = float(np.median(steps_m[usable] / periods_s[usable])) if usable.any() else 0.0
    delays_s = np.abs(sample.camera_times_s(camera) - sample.times_s)
    # Half a second is more than sensors of one frame differ by; a wrong clock must not excuse everything.
    return np.asarray(speed_m_s * np.minimum(np.nan_to_num(delays_s), 0.5), dtype=np.float64)
