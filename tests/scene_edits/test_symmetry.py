"""Faces that no camera saw: which are mirrored, and that a mirrored Gaussian is the reflection of its original."""

from __future__ import annotations

import numpy as np
import torch

from genre_tasks.logs.types import Lens
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Points, View
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.rotations import quats_to_matrices
from genre_tasks.scene_edits.actor_parts import ActorPart
from genre_tasks.scene_edits.symmetry import complete_by_symmetry, complete_points_by_symmetry

LENS = Lens(100.0, 100.0, 50.0, 50.0, 100, 100)
CAR = ActorNode("7", "car", (4.0, 2.0, 1.5), np.array([3]), np.eye(4)[None])


def look_at_car(x_m: float, y_m: float) -> View:
    """A view from a place in the car's box coordinates."""
    forward = -np.array([x_m, y_m, 0.0]) / np.hypot(x_m, y_m)
    down = np.array([0.0, 0.0, -1.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(down, forward), down, forward], 1)
    pose[:2, 3] = (x_m, y_m)
    return View("front", 3, "source", 0.3, pose, LENS, b"")


def make_part() -> ActorPart:
    generator = torch.Generator().manual_seed(0)
    packed = torch.randn(200, 14, generator=generator)
    packed[:, :3] = (torch.rand(200, 3, generator=generator) - 0.5) * torch.tensor(CAR.size_m)
    harmonics = torch.randn(200, 15, 3, generator=generator)
    return ActorPart(Gaussians.unpack(packed), harmonics, None)


def covariances(gaussians: Gaussians) -> torch.Tensor:
    axes = quats_to_matrices(gaussians.quats) * gaussians.log_scales.exp()[:, None]
    return axes @ axes.mT


def test_a_front_that_no_camera_saw_is_the_mirrored_rear():
    part = make_part()
    done = complete_by_symmetry(part, CAR, [look_at_car(-12.0, 0.0)])
    means = done.gaussians.means
    rear = torch.nonzero(part.gaussians.means[:, 0] <= -1.0)[:, 0]
    front = torch.nonzero(means[:, 0] >= 1.0)[:, 0]
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))
    assert torch.equal(means[front], part.gaussians.means[rear] @ flip)
    expected = flip @ covariances(part.gaussians)[rear] @ flip
    assert torch.allclose(covariances(done.gaussians)[front], expected, rtol=1e-4, atol=1e-4)
    # The middle and the rear stay.
    assert int((means[:, 0] < 1.0).sum()) == int((part.gaussians.means[:, 0] <= 1.0).sum())


def test_a_front_that_a_side_shows_in_profile_stays():
    part = make_part()
    assert (
        complete_by_symmetry(part, CAR, [look_at_car(-12.0, 0.0), look_at_car(-8.0, 6.0), look_at_car(-8.0, -6.0)])
        is part
    )


def test_a_side_is_mirrored_where_the_other_one_was_seen():
    part = make_part()
    done = complete_by_symmetry(part, CAR, [look_at_car(1.0, 8.0)]).gaussians.means
    assert int((done[:, 1] > 0).sum()) == int((done[:, 1] < 0).sum()) == int((part.gaussians.means[:, 1] > 0).sum())


def test_mirrored_harmonics_show_in_the_mirror_what_the_original_shows():
    from genre_tasks.scene.spherical_harmonics import evaluate_sh_basis

    part = make_part()
    done = complete_by_symmetry(part, CAR, [look_at_car(-12.0, 0.0)])
    rear = torch.nonzero(part.gaussians.means[:, 0] <= -1.0)[:, 0]
    front = torch.nonzero(done.gaussians.means[:, 0] >= 1.0)[:, 0]
    assert part.spherical_harmonics is not None and done.spherical_harmonics is not None
    direction = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.2]), dim=0)
    mirrored = direction * torch.tensor([-1.0, 1.0, 1.0])
    original = torch.stack(evaluate_sh_basis(direction, 15)) @ part.spherical_harmonics[rear]
    reflected = torch.stack(evaluate_sh_basis(mirrored, 15)) @ done.spherical_harmonics[front]
    assert torch.allclose(original, reflected, atol=1e-5)


def make_points(x_m: float) -> Points:
    """LiDAR points on a face across the car's length, in colours of their own, and one above its middle."""
    y, z = (values.ravel() for values in np.meshgrid([-0.8, 0.1, 0.9], [-0.5, 0.3]))
    positions = np.stack([np.full(len(y), x_m), y, z], 1)
    positions = np.concatenate([positions, [[0.0, 0.2, 0.7]]]).astype(np.float32)
    number = np.arange(len(positions))
    colors = np.repeat(number[:, None], 3, axis=1).astype(np.uint8)
    return Points(positions, colors, number % 2 == 0, number.astype(np.int16))


def test_points_of_a_front_that_no_camera_saw_are_those_of_the_mirrored_rear():
    rear = make_points(-2.0)
    done = complete_points_by_symmetry(rear, CAR, [look_at_car(-12.0, 0.0)], deforms=False)
    assert len(done) == 6 + 1 + 6
    assert np.array_equal(done.positions[:7], rear.positions)
    assert np.array_equal(done.positions[7:], rear.positions[:6] * np.array([-1, 1, 1], np.float32))
    assert np.array_equal(done.colors[7:], rear.colors[:6]) and np.array_equal(done.colored[7:], rear.colored[:6])
    assert np.array_equal(done.frames[7:], rear.frames[:6])
    # What LiDAR measured of the front goes, as the Gaussians there do.
    both = complete_points_by_symmetry(done, CAR, [look_at_car(-12.0, 0.0)], deforms=False)
    assert len(both) == len(done)


def test_points_stay_where_nothing_is_mirrored():
    front = make_points(2.0)
    rear_view = [look_at_car(-12.0, 0.0)]
    assert complete_points_by_symmetry(front, CAR, rear_view, deforms=True) is front
    # LiDAR hit the front alone, and cameras saw the rear.
    assert complete_points_by_symmetry(front, CAR, rear_view, deforms=False) is front
    profile = [*rear_view, look_at_car(-8.0, 6.0), look_at_car(-8.0, -6.0)]
    assert complete_points_by_symmetry(front, CAR, profile, deforms=False) is front
