"""Poses between the wire and matrices."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from flows.simulators.alpasim import common_pb2, sensorsim_pb2
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64
from genre_tasks.scene.transforms import compose_se3

MAX_COORDINATE_M = 1e6
"""Farther from the local frame's origin a float32 is no finer than centimetres, and no scene reaches that far."""

_NORM_TOLERANCE = 1e-2


def read_pose(pose: common_pb2.Pose, name: str) -> Float64:
    """Reads a pose.

    Args:
        pose: of the wire.
        name: what it is of, for errors.

    Returns:
        [4, 4] in the frame that the pose is stated in.

    Raises:
        InputError: a number is not finite or absurd, or the quaternion is not of unit length.

    >>> read_pose(common_pb2.Pose(vec={"x": 2.0}, quat={"w": 1.0}), "the camera")[0].tolist()
    [1.0, 0.0, 0.0, 2.0]
    """
    position = np.array([pose.vec.x, pose.vec.y, pose.vec.z], np.float64)
    quat = np.array([pose.quat.w, pose.quat.x, pose.quat.y, pose.quat.z], np.float64)
    if not (np.isfinite(position).all() and np.isfinite(quat).all()):
        raise InputError(f"the pose of {name} is not finite", remedy="Send finite numbers.")
    if np.abs(position).max() > MAX_COORDINATE_M:
        raise InputError(
            f"the pose of {name} is farther than {MAX_COORDINATE_M:g} m from the origin",
            remedy="Send it in the scene's local frame, whose origin is near the start of the path.",
        )
    # A missing pose has a quaternion of zeros: all numbers that the wire leaves out are 0.
    if abs(float(np.linalg.norm(quat)) - 1.0) > _NORM_TOLERANCE:
        raise InputError(f"the pose of {name} is missing or has no unit quaternion", remedy="Send w, x, y and z.")
    return compose_se3(Rotation.from_quat(quat, scalar_first=True).as_matrix(), position)


def read_pose_pair(pair: sensorsim_pb2.PosePair, name: str) -> tuple[Float64, Float64]:
    """Reads the poses at the start and the end of a readout.

    Args:
        pair: of the wire; a missing end is the start.
        name: what it is of, for errors.

    Returns:
        Two matrices [4, 4].

    Raises:
        InputError: as :func:`read_pose`.
    """
    start = read_pose(pair.start_pose, f"{name} at the start")
    end = read_pose(pair.end_pose, f"{name} at the end") if pair.HasField("end_pose") else start
    return start, end


def write_pose(matrix: Float64) -> common_pb2.Pose:
    """Writes a pose for the wire, as float32.

    Args:
        matrix: [4, 4].

    >>> write_pose(np.eye(4)).quat.w
    1.0
    """
    x, y, z = (float(value) for value in matrix[:3, 3])
    # The half of all quaternions with w >= 0: both halves mean the same rotations.
    quat = Rotation.from_matrix(matrix[:3, :3]).as_quat(scalar_first=True, canonical=True)
    qw, qx, qy, qz = (float(value) for value in quat)
    return common_pb2.Pose(
        vec=common_pb2.Vec3(x=x, y=y, z=z),
        quat=common_pb2.Quat(w=qw, x=qx, y=qy, z=qz),
    )
