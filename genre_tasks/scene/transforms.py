"""Rotations and rigid transforms, each in one place. Quaternions are w, x, y, z."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float32, Float64


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a ∘ b, [..., 4] × [..., 4] → [..., 4]; norms multiply."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def matrix_to_quat(rotation: Tensor) -> Tensor:
    """Unit quaternions of rotation matrices, [..., 3, 3] → [..., 4]; exact also for turns of 180°."""
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    return rotation_matrix_to_quaternion(rotation.contiguous())


def quat_to_matrix(quat: Float64) -> Float64:
    """Rotation matrices of quaternions that need not be unit, [..., 4] → [..., 3, 3], float64."""
    w, x, y, z = np.moveaxis(quat / np.linalg.norm(quat, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(r, -1) for r in rows], -2)


def se3(rotation: Float64, translation: Float64) -> Float64:
    """[..., 3, 3] and [..., 3] → [..., 4, 4] float64."""
    out = np.zeros((*rotation.shape[:-2], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, translation, 1.0
    return out


def se3_inverse(pose: Float64) -> Float64:
    """Inverse of rigid transforms [..., 4, 4], by transposition (exact for orthonormal rotations)."""
    turn = np.swapaxes(pose[..., :3, :3], -1, -2)
    return se3(turn, -(turn @ pose[..., :3, 3:])[..., 0])


def shift_laterally(chunk_SE3_camera: Float64, chunk_SE3_ego: Float64, shift_m: float) -> Float64:
    """A camera pose moved with the whole rig along the ego's lateral axis (left is +), rotation unchanged.

    The axis comes from the LiDAR pose's heading projected to the horizontal, which is defined at standstill too.
    """
    forward = chunk_SE3_ego[:3, 0].copy()
    forward[2] = 0.0
    forward /= np.linalg.norm(forward)
    out = chunk_SE3_camera.copy()
    out[:3, 3] += shift_m * np.array([-forward[1], forward[0], 0.0])
    return out


def interpolate_pose(start: Float64, end: Float64, t: float) -> Float64:
    """The rigid transform [4, 4] at ``t`` in [0, 1]: straight in position, the shortest turn in rotation.

    The relative turn is taken as a rotation vector, so it is exact for equal rotations, does not see the sign of
    quaternions, and picks one axis, always the same, for a half turn.
    """
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec()
    rotation = start[:3, :3] @ Rotation.from_rotvec(t * turn).as_matrix()
    return se3(rotation, (1 - t) * start[:3, 3] + t * end[:3, 3])


def rigid(pose: Float64, tolerance: float = 1e-3) -> bool:
    """Whether a [4, 4] matrix is finite and its rotation part is one."""
    if not np.isfinite(pose).all():
        return False
    turn = pose[:3, :3]
    return bool(np.abs(turn.T @ turn - np.eye(3)).max() < tolerance and np.linalg.det(turn) > 0)


def path_distance(positions: Float32, chunk_SE3_ego: Float64) -> Float32:
    """Distance [P] of points [P, 3] to the nearest ego position."""
    best = np.full(len(positions), np.inf, np.float32)
    for ego in chunk_SE3_ego[:, :3, 3].astype(np.float32):
        offset = positions - ego
        np.minimum(best, np.einsum("pk,pk->p", offset, offset), out=best)
    return np.sqrt(best)
