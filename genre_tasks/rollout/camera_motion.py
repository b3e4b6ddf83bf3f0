"""How the cameras of a rig move along an ego path: what a rolling shutter and motion blur need to know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.logs.types import Float64, MotionBlur, RollingShutter
from genre_tasks.rollout.rig import RigCamera, RolloutView
from genre_tasks.scene_edits.chunk_scene import ChunkScene


@dataclass(frozen=True)
class EgoMotion:
    """What the ego vehicle does around one pose of a path.

    Attributes:
        before: [4, 4] the pose before, in the log's world; at the path's start the pose itself.
        after: [4, 4] the pose after; at the path's end the pose itself.
        seconds: from the one to the other; 0 for a path of one pose.
        frame_s: seconds of a log frame at that place; 0 where the traffic rests.
    """

    before: Float64
    after: Float64
    seconds: float
    frame_s: float


def measure_ego_motion(path: EgoPath, index: int) -> EgoMotion:
    """Measures how the ego vehicle moves at a pose, by the poses before and after.

    Args:
        path: P poses.
        index: of the pose.

    Returns:
        The motion, by central differences as for recorded images.
    """
    first = max(index - 1, 0)
    last = min(index + 1, len(path) - 1)
    seconds = float(path.times_s[last] - path.times_s[first])
    frames = float(path.frames[last] - path.frames[first])
    frame_s = seconds / frames if frames > 0 else 0.0
    return EgoMotion(path.world_SE3_ego[first], path.world_SE3_ego[last], seconds, frame_s)


def place_rollout_views(
    path: EgoPath, index: int, rig: Sequence[RigCamera], chunk_scene: ChunkScene
) -> tuple[RolloutView, ...]:
    """Places the cameras of a rig at one pose of a path, with the motion that the path itself has there.

    Args:
        path: in the log's world.
        index: of the pose.
        rig: C cameras.
        chunk_scene: in whose coordinates the views are.

    Returns:
        C views.
    """
    chunk_SE3_world = np.linalg.inv(chunk_scene.chunk.world_SE3_chunk)
    chunk_SE3_ego = chunk_SE3_world @ path.world_SE3_ego[index]
    motion = measure_ego_motion(path, index)
    frame = float(path.frames[index])
    views = []
    for camera in rig:
        velocity, turn = _move_camera(camera.ego_SE3_camera, path.world_SE3_ego[index], motion)
        shutter = None
        blur = None
        if camera.readout_s and motion.seconds:
            shutter = RollingShutter(camera.readout_s, velocity_m_s=velocity, turn_rad_s=turn, frame_s=motion.frame_s)
        if camera.exposure_s and motion.seconds:
            blur = MotionBlur(camera.exposure_s, velocity_m_s=velocity, turn_rad_s=turn, frame_s=motion.frame_s)
        pose = chunk_SE3_ego @ camera.ego_SE3_camera
        views.append(RolloutView(camera.name, frame, pose, camera.lens, shutter, blur))
    return tuple(views)


def _move_camera(
    ego_SE3_camera: Float64, world_SE3_ego: Float64, motion: EgoMotion
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Velocity in m/s and turn in rad/s of a camera, in its axes; zeros without any time between the poses."""
    seconds = motion.seconds or np.inf
    before = motion.before @ ego_SE3_camera
    after = motion.after @ ego_SE3_camera
    camera_R_world = (world_SE3_ego @ ego_SE3_camera)[:3, :3].T
    turned = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
    vx, vy, vz = camera_R_world @ (after[:3, 3] - before[:3, 3]) / seconds
    wx, wy, wz = camera_R_world @ turned / seconds
    return (float(vx), float(vy), float(vz)), (float(wx), float(wy), float(wz))
