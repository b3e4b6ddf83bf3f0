"""Whether the cameras sit on the ego vehicle: near it, upright, and fixed to it while it moves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Camera, Float64
from genre_tasks.scene.transforms import interpolate_pose, is_rigid_transform

# The cab of an articulated truck or bus may be so far from its LiDAR.
_MAX_MOUNT_M = 12.0
# Cameras that look down at a kerb are pitched by 60°.
_MAX_TILT_DEG = 70.0
_RIGID_TOLERANCE = 1e-3
# Positioning noise, and what a path between two frames deviates from a straight line.
_MAX_MOUNT_MOTION_M = 0.3
_MAX_MOUNT_TURN_DEG = 3.0
# Of the motion that one assumption leaves, so little is left by a better one.
_EXPLAINED = 0.2
_AXES_REMEDY = "Camera poses must take x right, y down, z forward to the world: check axes and quaternion order."
_FRAME_REMEDY = "Give the poses of cameras and LiDAR in the same world frame, in metres, each at its own time."


def find_implausible_camera_poses(sample: LogSample) -> Iterator[Finding]:
    """Finds cameras that cannot be mounted on the vehicle in the way that their poses say.

    Args:
        sample: the frames of a chunk.

    Yields:
        For each camera ``improper_rotation``, ``odd_camera_orientation``, ``far_camera``, ``loose_camera`` or
        ``camera_pose_time``.
    """
    if find_improper(sample.world_SE3_lidar).size:
        return
    for camera in sample.cameras:
        world_SE3_camera = sample.world_SE3_camera(camera)
        both = np.concatenate([world_SE3_camera, sample.world_SE3_lidar], axis=2)
        readable: NDArray[np.bool_] = np.isfinite(both).all(axis=(1, 2))
        if not readable.any():
            continue
        if find_improper(world_SE3_camera).size:
            message = f"{camera.name}: the pose is mirrored, scaled or not at right angles"
            yield Finding("improper_rotation", "fatal", message, _AXES_REMEDY, camera=camera.name)
            continue
        mount = np.linalg.inv(sample.world_SE3_lidar[readable]) @ world_SE3_camera[readable]
        yield from _judge_orientation(camera, mount)
        far = _judge_distance(camera, mount)
        # A camera in another frame moves against the vehicle, too.
        yield from (far,) if far else _judge_mount_motion(sample, camera, world_SE3_camera, readable)


def find_improper(poses: Float64) -> NDArray[np.int64]:
    """Finds poses that are no rotation and translation.

    Args:
        poses: [F, 4, 4]; NaN where there is none.

    Returns:
        Indices of poses whose axes are mirrored, scaled or not at right angles, or whose last row is not 0, 0, 0, 1.
    """
    known = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    bad = [
        not (is_rigid_transform(poses[k], _RIGID_TOLERANCE) and np.array_equal(poses[k, 3], (0, 0, 0, 1)))
        for k in known
    ]
    return known[np.array(bad, dtype=bool)]


def _judge_orientation(
    camera: Camera,
    lidar_SE3_camera: Float64,  # [F, 4, 4]
) -> Iterator[Finding]:
    """A finding where the image's down is not the vehicle's."""
    rotation = np.median(lidar_SE3_camera[:, :3, :3], axis=0)
    down = float(np.clip(-rotation[2, 1], -1, 1))
    tilt_deg = float(np.degrees(np.arccos(down)))
    if tilt_deg <= _MAX_TILT_DEG:
        return
    upward = float(rotation[2, 2])
    if upward > np.cos(np.deg2rad(90 - _MAX_TILT_DEG)):
        direction = "looks at the sky, as with a vehicle's axes (x forward, z up)"
    elif upward < -np.cos(np.deg2rad(90 - _MAX_TILT_DEG)):
        direction = "looks at the ground"
    elif down < 0:
        direction = "is upside down, as with the axes of OpenGL (y up, z backward)"
    else:
        direction = "lies on its side"
    message = (
        f"{camera.name} {direction}: its y axis is {tilt_deg:.0f}° off the vehicle's down; "
        f"{_MAX_TILT_DEG:.0f}° are plausible at most"
    )
    numbers = {"tilt_deg": tilt_deg, "limit_deg": _MAX_TILT_DEG}
    yield Finding("odd_camera_orientation", "warning", message, _AXES_REMEDY, numbers, camera.name)


def _judge_distance(
    camera: Camera,
    lidar_SE3_camera: Float64,  # [F, 4, 4]
) -> Finding | None:
    distance_m = float(np.median(np.linalg.norm(lidar_SE3_camera[:, :3, 3], axis=1)))
    if distance_m <= _MAX_MOUNT_M:
        return None
    message = (
        f"{camera.name} is {distance_m:.4g} m away from the LiDAR's pose; {_MAX_MOUNT_M:g} m are plausible at most"
    )
    numbers = {"distance_m": distance_m, "limit_m": _MAX_MOUNT_M}
    return Finding("far_camera", "warning", message, _FRAME_REMEDY, numbers, camera.name)


def _judge_mount_motion(
    sample: LogSample,
    camera: Camera,
    world_SE3_camera: Float64,  # [F, 4, 4]
    readable: NDArray[np.bool_],  # [F]
) -> Iterator[Finding]:
    """A finding where a camera moves against the vehicle, at the times of its images and at those of the sweeps."""
    at_image_times = _poses_at(sample, sample.camera_times_s(camera))
    usable = readable & np.isfinite(at_image_times).all(axis=(1, 2))
    if usable.sum() < 2:
        return
    frames = tuple(sample.frames[k] for k in np.flatnonzero(usable))
    moved_m, turned_deg = _measure_motion(at_image_times[usable], world_SE3_camera[usable])
    worst = int(np.maximum(moved_m / _MAX_MOUNT_MOTION_M, turned_deg / _MAX_MOUNT_TURN_DEG).argmax())
    if moved_m[worst] <= _MAX_MOUNT_MOTION_M and turned_deg[worst] <= _MAX_MOUNT_TURN_DEG:
        return
    numbers = {
        "moved_m": float(moved_m[worst]),
        "limit_m": _MAX_MOUNT_MOTION_M,
        "turned_deg": float(turned_deg[worst]),
        "limit_deg": _MAX_MOUNT_TURN_DEG,
    }
    moved = f"{moved_m[worst]:.2f} m and {turned_deg[worst]:.1f}°"
    limits = f"{_MAX_MOUNT_MOTION_M:g} m and {_MAX_MOUNT_TURN_DEG:g}° are plausible"
    sweep_moved_m, sweep_turned_deg = _measure_motion(sample.world_SE3_lidar[usable], world_SE3_camera[usable])
    is_fixed_at_sweeps = (
        sweep_moved_m.max() < _EXPLAINED * moved_m.max() and sweep_turned_deg.max() <= _MAX_MOUNT_TURN_DEG
    )
    if is_fixed_at_sweeps:
        message = (
            f"{camera.name}: its poses fit the vehicle at the times of the sweeps, not at those of its images: "
            f"there they are off by up to {moved} ({limits})"
        )
        remedy = "Give each image the pose at its own time, or the sweep's time where both were taken together."
        yield Finding("camera_pose_time", "warning", message, remedy, numbers, camera.name)
        return
    message = f"{camera.name} moves against the vehicle by up to {moved}, at frame {frames[worst]}; {limits}"
    yield Finding("loose_camera", "warning", message, _FRAME_REMEDY, numbers, camera.name, (frames[worst],))


def _measure_motion(
    world_SE3_lidar: Float64,  # [F, 4, 4]
    world_SE3_camera: Float64,  # [F, 4, 4]
) -> tuple[Float64, Float64]:
    """[F] metres and degrees by which the mount of a camera deviates from its median over frames."""
    from scipy.spatial.transform import Rotation

    mount = np.linalg.inv(world_SE3_lidar) @ world_SE3_camera
    moved_m = np.linalg.norm(mount[:, :3, 3] - np.median(mount[:, :3, 3], axis=0), axis=1)
    rotations = Rotation.from_matrix(mount[:, :3, :3])
    turned_rad = (rotations.mean().inv() * rotations).magnitude()
    return moved_m, np.degrees(turned_rad)


def _poses_at(sample: LogSample, times_s: Float64) -> Float64:
    """[F, 4, 4] poses of the LiDAR at other times, on straight lines and even turns between frames and beyond the ends.

    NaN where a time is unknown, or farther from the chunk than two frames.
    """
    poses = np.full((len(times_s), 4, 4), np.nan)
    known = np.isfinite(sample.world_SE3_lidar).all(axis=(1, 2)) & np.isfinite(sample.times_s)
    frame_times = sample.times_s[known]
    if len(frame_times) < 2 or not (np.diff(frame_times) > 0).all():
        return poses
    frame_poses = sample.world_SE3_lidar[known]
    margin = 2 * float(np.median(np.diff(frame_times)))
    for k, time in enumerate(times_s):
        if not frame_times[0] - margin <= time <= frame_times[-1] + margin:
            continue
        start = int(np.clip(np.searchsorted(frame_times, time, side="right") - 1, 0, len(frame_times) - 2))
        fraction = (time - frame_times[start]) / (frame_times[start + 1] - frame_times[start])
        # Beyond an end, the fraction goes beyond 0 to 1 and the motion goes on as it was.
        poses[k] = interpolate_pose(frame_poses[start], frame_poses[start + 1], float(fraction))
    return poses
