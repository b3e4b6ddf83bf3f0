"""Other ways in which the poses of a log may have been meant: quaternion orders, directions, axes, handedness."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float64
from genre_tasks.scene.transforms import compose_se3, invert_se3, is_rigid_transform

# [3, 3] x forward, y left, z up expressed in other axes that recordings use for a vehicle or its LiDAR.
_AXES: dict[str, Float64] = {
    "x right, y forward, z up": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "x forward, y right, z down": np.diag([1.0, -1.0, -1.0]),
    "x right, y down, z forward": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
}
# Far more than the circumference of the Earth: sums of larger numbers lose centimetres, or overflow.
_MAX_COORDINATE_M = 1e9
# Mirror images are no rotations: the y axis points to the other side.
_MIRROR = np.diag([1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Reading:
    """A way to read the poses of a log, or to place its points.

    Attributes:
        name: completes the sentence "it fits better with …".
        world_SE3_lidar: [F, 4, 4] the poses so read.
    """

    name: str
    world_SE3_lidar: Float64


def find_rigid(poses: Float64) -> NDArray[np.bool_]:
    """Finds the poses that can be compared: others find what is wrong with the rest.

    Args:
        poses: [F, 4, 4], with NaN where one cannot be read.

    Returns:
        [F] true where a pose is finite, not absurdly far, and turns without mirroring or scaling.

    >>> find_rigid(np.stack([np.eye(4), 2 * np.eye(4), np.full((4, 4), np.nan)])).tolist()
    [True, False, False]
    """
    near = np.abs(np.nan_to_num(poses[:, :3, 3], nan=np.inf)).max(axis=1) < _MAX_COORDINATE_M
    return near & np.array([is_rigid_transform(pose) for pose in poses], dtype=bool)


def find_measurable(points: Float64) -> NDArray[np.bool_]:
    """Finds the points [N, 3] whose coordinates are numbers that can be compared: [N]."""
    # NaN compares false.
    return np.asarray((np.abs(points) < _MAX_COORDINATE_M).all(axis=1))


def reread_rotations(world_SE3_lidar: Float64) -> Iterator[Reading]:
    """Reads the rotations of poses as other conventions would have them; positions stay.

    Args:
        world_SE3_lidar: [F, 4, 4] as the log has them, axes x forward, y left, z up.

    Yields:
        Readings with another order of the quaternion, the conjugate, and the inverse pose.
    """
    for axes_R_flu in (np.eye(3), _AXES["x right, y forward, z up"]):
        # A reader turned the file's axes to x forward, y left, z up: the quaternion is that of the file's axes.
        quats = _quats_from_matrices(world_SE3_lidar[:, :3, :3] @ axes_R_flu.T)
        orders = {
            "quaternions read as x, y, z, w": quats[:, [3, 0, 1, 2]],
            "quaternions whose w, x, y, z were taken for x, y, z, w": quats[:, [1, 2, 3, 0]],
            "conjugate quaternions": quats * np.array([1.0, -1.0, -1.0, -1.0]),
        }
        for name, values in orders.items():
            rotation = _matrices_from_quats(values) @ axes_R_flu
            yield Reading(name, compose_se3(rotation, world_SE3_lidar[:, :3, 3]))
        inverse = invert_se3(_turn(world_SE3_lidar, axes_R_flu.T))
        yield Reading("inverse poses", _turn(inverse, axes_R_flu))


def _turn(poses: Float64, rotation: Float64) -> Float64:
    turned: Float64 = poses @ compose_se3(rotation, np.zeros(3))
    return turned


def list_placements(world_SE3_lidar: Float64) -> Iterator[Reading]:
    """Lists other places where the points of sweeps may belong.

    Args:
        world_SE3_lidar: [F, 4, 4] as the log has them.

    Yields:
        Readings whose ``world_SE3_lidar`` is to be applied to the points that the log calls world coordinates.
    """
    yield Reading("points taken as LiDAR coordinates (x forward, y left, z up)", world_SE3_lidar)
    for name, axes_R_flu in _AXES.items():
        yield Reading(f"points taken as LiDAR coordinates ({name})", _turn(world_SE3_lidar, axes_R_flu.T))
    mirrored = world_SE3_lidar @ compose_se3(_MIRROR, np.zeros(3))
    yield Reading("points taken as LiDAR coordinates with y mirrored", mirrored)
    lidar_SE3_world = invert_se3(world_SE3_lidar)
    yield Reading("the poses removed, which were applied twice", lidar_SE3_world)
    # All of them, so that what stands still moves with the vehicle.
    first = world_SE3_lidar @ invert_se3(world_SE3_lidar[0])
    yield Reading("points that were all placed by the first pose placed by the pose of their frame", first)
    yield Reading("points mirrored in the LiDAR's axes", mirrored @ lidar_SE3_world)
    for reading in reread_rotations(world_SE3_lidar):
        yield Reading(reading.name, reading.world_SE3_lidar @ lidar_SE3_world)
        undone = world_SE3_lidar @ invert_se3(reading.world_SE3_lidar)
        yield Reading(f"points that were placed by {reading.name} placed by the poses", undone)


def _quats_from_matrices(rotation: Float64) -> Float64:
    from scipy.spatial.transform import Rotation

    quats: Float64 = Rotation.from_matrix(rotation).as_quat()[:, [3, 0, 1, 2]]
    return quats


def _matrices_from_quats(quats: Float64) -> Float64:
    from scipy.spatial.transform import Rotation

    matrices: Float64 = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    return matrices
