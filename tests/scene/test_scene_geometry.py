"""Rotations, interpolation, lateral shifts, actors in the scene graph."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.geometry import (
    interpolate_pose,
    matrix_to_quat,
    quat_multiply,
    quat_to_matrix,
    rigid,
    se3_inverse,
    shift_laterally,
)
from genre_tasks.scene.graph import FIRST_ACTOR, ActorNode, SceneGraph
from tests.fakes import yaw_pose


def test_quaternions_and_matrices_agree() -> None:
    turns = Rotation.random(50, random_state=0).as_matrix()
    half_turns = np.stack([np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])])
    both = np.concatenate([turns, half_turns])
    quats = matrix_to_quat(torch.from_numpy(both))
    assert np.allclose(quat_to_matrix(-3.0 * quats.numpy()), both, atol=1e-12)
    product = quat_multiply(quats[:25], quats[25:50]).numpy()
    assert np.allclose(quat_to_matrix(product), turns[:25] @ turns[25:], atol=1e-12)


def test_inverse() -> None:
    pose = yaw_pose(0.7, (4e6, -3.0, 2.0))
    assert np.allclose(se3_inverse(pose) @ pose, np.eye(4), atol=1e-9)


@pytest.mark.parametrize("yaw", [0.0, 1e-12, 0.5, np.pi - 1e-9, np.pi, -np.pi, 3.5])
def test_interpolation_is_the_shortest_turn(yaw: float) -> None:
    start, end = yaw_pose(0.3, (0.0, 0.0, 0.0)), yaw_pose(0.3 + yaw, (2.0, 4.0, 0.0))
    assert np.allclose(interpolate_pose(start, end, 0.0), start, atol=1e-9)
    assert np.allclose(interpolate_pose(start, end, 1.0), end, atol=1e-9)
    middle = interpolate_pose(start, end, 0.5)
    assert rigid(middle, 1e-9) and np.allclose(middle[:3, 3], [1, 2, 0])
    angle = np.arccos(np.clip((np.trace(start[:3, :3].T @ middle[:3, :3]) - 1) / 2, -1, 1))
    shortest = abs((yaw + np.pi) % (2 * np.pi) - np.pi)
    assert angle == pytest.approx(shortest / 2, abs=1e-6)


def test_rigid_refuses() -> None:
    assert rigid(np.eye(4))
    mirrored, stretched, broken = np.eye(4), np.eye(4), np.eye(4)
    mirrored[0, 0], stretched[1, 1], broken[0, 3] = -1, 1.1, np.nan
    assert not (rigid(mirrored) or rigid(stretched) or rigid(broken))


def test_shift_is_to_the_left_and_horizontal() -> None:
    ego = yaw_pose(np.pi / 2, (0.0, 0.0, 0.0))
    tilted = ego @ np.block([[Rotation.from_euler("y", -20, degrees=True).as_matrix(), np.zeros((3, 1))], [0, 0, 0, 1]])
    shifted = shift_laterally(np.eye(4), tilted, 3.0)
    assert np.allclose(shifted[:3, 3], [-3, 0, 0], atol=1e-12) and np.array_equal(shifted[:3, :3], np.eye(3))


def _one_actor_graph(yaw: float) -> SceneGraph:
    gaussians = Gaussians(
        torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), torch.zeros(2, 3), torch.tensor([[1.0, 0, 0, 0]] * 2),
        torch.zeros(2), torch.zeros(2, 3),
    )  # fmt: skip
    actor = ActorNode("a", "car", (4.0, 2.0, 1.5), np.array([3]), yaw_pose(yaw, (10.0, 0.0, 0.0))[None])
    return SceneGraph(gaussians, torch.tensor([0, FIRST_ACTOR]), (actor,))


@pytest.mark.parametrize("yaw", [0.0, 0.4, np.pi, -np.pi])
def test_actor_at_any_yaw_also_a_half_turn(yaw: float) -> None:
    posed = _one_actor_graph(yaw).at(3)
    assert torch.allclose(posed.means[0], torch.tensor([1.0, 0, 0]))
    assert np.allclose(posed.means[1].numpy(), [10 + np.cos(yaw), np.sin(yaw), 0], atol=1e-6)
    assert np.allclose(quat_to_matrix(posed.quats[1].double().numpy()), yaw_pose(yaw, (0, 0, 0))[:3, :3], atol=1e-6)


def test_actor_absent_past_its_track() -> None:
    posed = _one_actor_graph(0.0).at(4)
    assert float(torch.sigmoid(posed.logit_opacities[1])) < 1 / 255 and float(posed.logit_opacities[0]) == 0.0
