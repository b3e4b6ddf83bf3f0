"""Where nodes are: transforms of glTF, and Gaussians moved by them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.exchange.clouds import transform_cloud
from genre_tasks.exchange.sh_rotation import rotate_sh
from genre_tasks.exchange.types import SplatCloud
from genre_tasks.logs.types import Float64
from genre_tasks.scene.rotations import matrices_to_quats

GLTF_R_SCENE: Float64 = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""[3, 3] takes scene coordinates (x forward, y left, z up) to those of glTF (x left, y up, z to the front)."""

ROOT_ROTATION = (-0.5, -0.5, -0.5, 0.5)
"""The same as a quaternion x, y, z, w, exact in any precision."""

# A node of this size or less is hidden; glTF hides nodes by a scale of 0.
_HIDDEN_SCALE = 1e-9
# Rounding of float32 in rotations, many times over.
_RIGID_TOLERANCE = 1e-3
_SAME_SCALE = 1e-5
_FARTHEST = 1e30
_REMEDY = "Export it with nodes that are moved, turned and scaled evenly."


def compose_transforms(translation: Float64, rotation: Float64, scale: Float64) -> Float64:
    """Builds matrices of what nodes state.

    Args:
        translation: [F, 3].
        rotation: [F, 4] quaternions x, y, z, w, not zero.
        scale: [F, 3].

    Returns:
        [F, 4, 4].

    >>> turn = compose_transforms(np.zeros((1, 3)), np.array([ROOT_ROTATION]), np.ones((1, 3)))
    >>> bool((turn[0, :3, :3] == GLTF_R_SCENE).all())
    True
    """
    # By the largest part first: the square of a huge number would overflow.
    bounded = rotation / np.abs(rotation).max(1, keepdims=True)
    x, y, z, w = (bounded / np.linalg.norm(bounded, axis=1, keepdims=True)).T
    turn = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        1,
    )
    out = np.broadcast_to(np.eye(4), (len(translation), 4, 4)).copy()
    out[:, :3, :3] = turn * scale[:, None, :]
    out[:, :3, 3] = translation
    return out


def apply_transform(path: Path, cloud: SplatCloud, scene_T_node: Float64) -> SplatCloud:
    """Takes Gaussians of a node that rests to the scene's coordinates.

    Args:
        path: of the file, for the error.
        cloud: in the node's coordinates.
        scene_T_node: [4, 4], of any positive scales.

    Returns:
        In the scene's coordinates; those of the identity have the same bits.

    Raises:
        InputError: the transform mirrors, or makes things flat.
    """
    if np.array_equal(scene_T_node, np.eye(4)):
        return cloud
    _check_range(path, scene_T_node)
    linear = scene_T_node[:3, :3]
    scales = np.linalg.norm(linear, axis=0)
    if scales.min() <= _HIDDEN_SCALE or np.linalg.det(linear / scales) <= 0:
        raise InputError("a node of the file is mirrored or flat", remedy=_REMEDY, file=path)
    if np.abs(linear.T @ linear / scales[0] ** 2 - np.eye(3)).max() < _SAME_SCALE:
        return transform_cloud(scale_cloud(cloud, float(scales[0])), _make_pose(linear / scales[0], scene_T_node))
    return _stretch_cloud(cloud, scene_T_node)


def _check_range(path: Path, transforms: Float64) -> None:
    # Written so that NaN is found too. Float32, as which Gaussians are stored, ends where this does.
    if not (np.abs(transforms) < _FARTHEST).all():
        raise InputError("a node of the file is not at a finite place", remedy=_REMEDY, file=path)


def _make_pose(rotation: Float64, transform: Float64) -> Float64:
    pose = transform.copy()
    pose[:3, :3] = rotation
    return pose


def scale_cloud(cloud: SplatCloud, factor: float) -> SplatCloud:
    """Makes a cloud larger or smaller about its origin.

    Args:
        cloud: any.
        factor: above 0; within rounding of 1 the cloud stays as it is.
    """
    if abs(factor - 1) < _SAME_SCALE:
        return cloud
    log_scales = (cloud.log_scales.astype(np.float64) + np.log(factor)).astype(np.float32)
    return replace(cloud, means=(cloud.means.astype(np.float64) * factor).astype(np.float32), log_scales=log_scales)


def _stretch_cloud(cloud: SplatCloud, transform: Float64) -> SplatCloud:
    """Moves a cloud by any affine map.

    Axes of the new ellipsoids are the left singular vectors of map · rotation · scales, and their sizes its values.
    """
    linear = transform[:3, :3]
    quats = cloud.quats.astype(np.float64)
    identity = np.zeros((len(cloud), 3))
    axes = compose_transforms(identity, np.roll(quats, -1, axis=1), np.exp(cloud.log_scales.astype(np.float64)))
    left, sizes, _ = np.linalg.svd(linear @ axes[:, :3, :3])
    # A mirrored set of axes spans the same ellipsoid as one with its last axis reversed.
    left[:, :, 2] *= np.sign(np.linalg.det(left))[:, None]
    turn = np.linalg.svd(linear)
    return replace(
        cloud,
        means=(cloud.means.astype(np.float64) @ linear.T + transform[:3, 3]).astype(np.float32),
        quats=matrices_to_quats(torch.from_numpy(left)).numpy().astype(np.float32),
        log_scales=np.log(np.maximum(sizes, np.finfo(np.float32).tiny)).astype(np.float32),
        # Harmonics turn with the rotation that is nearest to the map.
        sh_rest=rotate_sh(cloud.sh_rest, turn[0] @ turn[2]),
    )


class RigidMotion(NamedTuple):
    """A node's transforms, taken apart.

    Attributes:
        scene_SE3_node: [F, 4, 4] without scale; the identity where the node is hidden.
        present: [F] whether the node is there.
        scale: the node's scale at the first moment that it is there; 1 if it never is.
        scale_changes: whether it has another scale at another moment.
    """

    scene_SE3_node: Float64
    present: NDArray[np.bool_]
    scale: float
    scale_changes: bool


def split_motion(path: Path, transforms: Float64) -> RigidMotion:
    """Takes a moving node's transforms apart.

    Args:
        path: of the file, for the error.
        transforms: [F, 4, 4] from the node's coordinates to the scene's.

    Returns:
        Poses, presence and scale.

    Raises:
        InputError: the node is mirrored, sheared or scaled unevenly.
    """
    _check_range(path, transforms)
    scales = np.linalg.norm(transforms[:, :3, :3], axis=1)
    present = scales.max(1) > _HIDDEN_SCALE
    size = np.where(present, scales[:, 0], 1.0)
    poses = np.broadcast_to(np.eye(4), transforms.shape).copy()
    rotations = transforms[present, :3, :3] / np.maximum(size[present, None, None], _HIDDEN_SCALE)
    off = np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max(initial=0.0)
    if off > _RIGID_TOLERANCE or (np.linalg.det(rotations) < 0).any():
        raise InputError("a moving node of the file is mirrored or scaled unevenly", remedy=_REMEDY, file=path)
    poses[present, :3, :3] = rotations
    poses[present, :3, 3] = transforms[present, :3, 3]
    scale = float(size[present][0]) if present.any() else 1.0
    changes = bool((np.abs(size[present] / scale - 1) > _RIGID_TOLERANCE).any())
    return RigidMotion(poses, present, scale, changes)
