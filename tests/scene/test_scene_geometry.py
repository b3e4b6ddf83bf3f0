"""Rotations, interpolation, lateral shifts, actors in the scene graph."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from genre_tasks.scene.rotations import matrices_to_quats, multiply_quats, quats_to_matrices_numpy
from genre_tasks.scene.transforms import invert_se3, is_rigid_transform, shift_laterally
from tests.fakes import yaw_pose


def test_quaternions_and_matrices_agree() -> None:
    turns = Rotation.random(50, random_state=0).as_matrix()
    half_turns = np.stack([np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])])
    both = np.concatenate([turns, half_turns])
    quats = matrices_to_quats(torch.from_numpy(both))
    assert np.allclose(quats_to_matrices_numpy(-3.0 * quats.numpy()), both, atol=1e-12)
    product = multiply_quats(quats[:25], quats[25:50]).numpy()
    assert np.allclose(quats_to_matrices_numpy(product), turns[:25] @ turns[25:], atol=1e-12)


def test_inverse() -> None:
    pose = yaw_pose(0.7, (4e6, -3.0, 2.0))
    assert np.allclose(invert_se3(pose) @ pose, np.eye(4), atol=1e-9)


def test_rigid_refuses() -> None:
    assert is_rigid_transform(np.eye(4))
    mirrored, stretched, broken = np.eye(4), np.eye(4), np.eye(4)
    mirrored[0, 0], stretched[1, 1], broken[0, 3] = -1, 1.1, np.nan
    assert not (is_rigid_transform(mirrored) or is_rigid_transform(stretched) or is_rigid_transform(broken))


def test_shift_is_to_the_left_and_horizontal() -> None:
    ego = yaw_pose(np.pi / 2, (0.0, 0.0, 0.0))
    tilted = ego @ np.block([[Rotation.from_euler("y", -20, degrees=True).as_matrix(), np.zeros((3, 1))], [0, 0, 0, 1]])
    shifted = shift_laterally(np.eye(4), tilted, 3.0)
    assert np.allclose(shifted[:3, 3], [-3, 0, 0], atol=1e-12) and np.array_equal(shifted[:3, :3], np.eye(3))
