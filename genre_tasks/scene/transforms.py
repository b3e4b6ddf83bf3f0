"""Rigid transforms as [4, 4] matrices in float64: made, inverted, checked, interpolated, shifted sideways."""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.types import Float32, Float64


def compose_se3(rotation: Float64, translation: Float64) -> Float64:
    """Puts rotations and translations together as homogeneous matrices.

    Args:
        rotation: [..., 3, 3].
        translation: [..., 3].

    Returns:
        [..., 4, 4] float64.

    >>> compose_se3(np.eye(3), np.array([1.0, 2.0, 3.0]))[:3, 3].tolist()
    [1.0, 2.0, 3.0]
    """
    out = np.zeros((*rotation.shape[:-2], 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def invert_se3(pose: Float64) -> Float64:
    """Inverts rigid transforms [..., 4, 4] by transposing their rotations: exact where these are orthonormal.

    >>> invert_se3(compose_se3(np.eye(3), np.array([1.0, 2.0, 3.0])))[:3, 3].tolist()
    [-1.0, -2.0, -3.0]
    """
    # Transposed, as a general inverse would let rounding errors grow from pose to pose.
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    return compose_se3(rotation, -(rotation @ pose[..., :3, 3:])[..., 0])


def shift_laterally(chunk_SE3_camera: Float64, chunk_SE3_ego: Float64, shift_m: float) -> Float64:
    """Moves a camera pose with the whole rig along the ego vehicle's lateral axis.

    The axis follows from the LiDAR pose's heading in the horizontal plane, which is defined at standstill too.

    Args:
        chunk_SE3_camera: [4, 4].
        chunk_SE3_ego: [4, 4] LiDAR pose, x forward, of the same frame.
        shift_m: positive is left.

    Returns:
        The moved camera pose [4, 4], with its rotation as it was.

    >>> shift_laterally(np.eye(4), np.eye(4), 3.0)[:3, 3].tolist()
    [0.0, 3.0, 0.0]
    """
    forward = chunk_SE3_ego[:3, 0].copy()
    # Horizontal, so that a shifted camera keeps its height over the road when the vehicle rolls.
    forward[2] = 0.0
    forward /= np.linalg.norm(forward)
    out = chunk_SE3_camera.copy()
    out[:3, 3] += shift_m * np.array([-forward[1], forward[0], 0.0])
    return out


def interpolate_pose(start: Float64, end: Float64, t: float) -> Float64:
    """Interpolates between two rigid transforms: straight in position, by the shortest turn in rotation.

    The relative turn is a rotation vector. So the result is exact for equal rotations, does not depend on the sign of
    quaternions, and takes always the same axis for half a turn.

    Args:
        start: [4, 4], the result at ``t`` 0.
        end: [4, 4], the result at ``t`` 1.
        t: in [0, 1].

    Returns:
        The transform [4, 4] at ``t``.
    """
    from scipy.spatial.transform import Rotation

    # Relative to the start: the shortest turn between the two, not between either and the identity.
    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    rotation = start[:3, :3] @ Rotation.from_rotvec(t * turn).as_matrix()
    return compose_se3(rotation, (1 - t) * start[:3, 3] + t * end[:3, 3])


def is_rigid_transform(pose: Float64, tolerance: float = 1e-3) -> bool:
    """Tells whether a [4, 4] matrix is finite and its rotation part orthonormal and right-handed.

    Args:
        pose: [4, 4].
        tolerance: largest error of an entry of RᵀR.

    >>> is_rigid_transform(np.eye(4)), is_rigid_transform(2 * np.eye(4))
    (True, False)
    """
    if not np.isfinite(pose).all():
        return False
    rotation = pose[:3, :3]
    # The determinant tells a mirror image apart, which is orthonormal too.
    return bool(np.abs(rotation.T @ rotation - np.eye(3)).max() < tolerance and np.linalg.det(rotation) > 0)


def distance_to_path(positions: Float32, chunk_SE3_ego: Float64) -> Float32:
    """Measures how far points are from the ego vehicle's path.

    Args:
        positions: [P, 3] metres, chunk coordinates.
        chunk_SE3_ego: [F, 4, 4].

    Returns:
        Metres [P] to the nearest ego position.

    >>> distance_to_path(np.array([[3.0, 4.0, 0.0]], np.float32), np.eye(4)[None]).tolist()
    [5.0]
    """
    # One frame at a time: a [P, F] table of all distances would take gigabytes for a chunk's points.
    best = np.full(len(positions), np.inf, np.float32)
    for ego in chunk_SE3_ego[:, :3, 3].astype(np.float32):
        offset = positions - ego
        np.minimum(best, np.einsum("pk,pk->p", offset, offset), out=best)
    return np.sqrt(best)
