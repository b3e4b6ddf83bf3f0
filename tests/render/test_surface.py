"""Depth of the planes that discs lie on: exact on a road at a grazing angle, where centres' depths are biased."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from genre_tasks.logs.types import Lens
from genre_tasks.render import render_views
from genre_tasks.render.surface import compute_normals, render_surfaces
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph

LENS = Lens(80.0, 80.0, 48.0, 32.0, 96, 64)
UP_PX = 40  # rows from here on see the road nearer than 20 m


@dataclass(frozen=True)
class Posed:
    frame: int
    chunk_SE3_camera: np.ndarray
    lens: Lens = LENS


def road(spacing: float = 0.5, opacity: float = 3.0, thin: float = 0.01) -> Gaussians:
    """Discs on the plane y = 1.6 below a camera that looks along z."""
    x, z = torch.meshgrid(torch.arange(-15, 15, spacing), torch.arange(1, 40, spacing), indexing="ij")
    count = x.numel()
    means = torch.stack([x.reshape(-1), torch.full((count,), 1.6), z.reshape(-1)], 1)
    scales = torch.tensor([0.7 * spacing, thin, 0.7 * spacing]).log().expand(count, 3)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    return Gaussians(means, scales, quats, torch.full((count,), opacity), torch.full((count, 3), 0.5))


def graph(gaussians: Gaussians) -> SceneGraph:
    return SceneGraph(gaussians, torch.zeros(len(gaussians), dtype=torch.int64), ())


def true_depth() -> torch.Tensor:
    rows = torch.arange(UP_PX, 64) + 0.5
    return (1.6 * 80 / (rows - 32))[:, None].expand(-1, 60)


def test_a_road_at_a_grazing_angle_is_where_it_is():
    out, plain = (draw(graph(road()), [Posed(0, np.eye(4))]) for draw in (render_surfaces, render_views))
    window = (0, slice(UP_PX, 64), slice(18, 78))
    truth = true_depth()
    error, biased = ((r.expected_depth()[window] / truth - 1).abs() for r in (out, plain))
    assert float(error.max()) < 0.005
    assert float(biased.mean()) > 10 * float(error.mean())
    assert torch.equal(out.color, plain.color) and torch.equal(out.alpha, plain.alpha)


def test_planes_turn_and_move_with_views_and_actors():
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(0.2), 0, np.sin(0.2)], [0, 1, 0], [-np.sin(0.2), 0, np.cos(0.2)]]
    turn[:3, 3] = 0.5, 0.2, 1.0
    g = road()
    actor = ActorNode("a", "car", (40.0, 40.0, 4.0), np.array([3]), np.linalg.inv(turn)[None])
    moved = SceneGraph(g, torch.full((len(g),), FIRST_ACTOR), (actor,))
    # the actor's box moved by the inverse of the view's motion: camera and road stand to each other as before
    seen = render_surfaces(moved, [Posed(3, np.linalg.inv(turn)), Posed(2, np.linalg.inv(turn))])
    alone = render_surfaces(graph(g), [Posed(0, np.eye(4))])
    torch.testing.assert_close(
        seen.expected_depth()[0, UP_PX:], alone.expected_depth()[0, UP_PX:], rtol=1e-3, atol=1e-3
    )
    assert not seen.alpha[1].any()  # no actor at that frame


@pytest.mark.parametrize("angle", [0.0, np.pi / 2])
def test_where_planes_do_not_meet_the_centres_count(angle):
    # one ball, and one disc seen exactly on edge, 5 m ahead
    quats = torch.tensor([[np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]], dtype=torch.float32)
    g = Gaussians(
        torch.tensor([[0.0, 0.0, 5.0]]),
        torch.log(torch.tensor([[0.5, 0.5, 0.01 if angle else 0.5]])),
        quats,
        torch.tensor([4.0]),
        torch.full((1, 3), 0.5),
    )
    out = render_surfaces(graph(g), [Posed(0, np.eye(4))])
    seen = out.alpha[0] > 0.1
    assert seen.any()
    torch.testing.assert_close(out.expected_depth()[0][seen], torch.full((int(seen.sum()),), 5.0), rtol=1e-3, atol=0)


def test_normals_are_along_the_shortest_axis():
    half = float(np.sqrt(0.5))
    g = Gaussians(
        torch.zeros(3, 3),
        torch.log(torch.tensor([[1.0, 1, 0.1], [0.1, 1, 1], [1, 1, 0.1]])),
        torch.tensor([[2.0, 0, 0, 0], [1, 0, 0, 0], [half, half, 0, 0]]),
        torch.zeros(3),
        torch.zeros(3, 3),
    )
    expected = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]])  # a quarter turn about x takes z to −y
    torch.testing.assert_close(compute_normals(g.activate()), expected, atol=1e-6, rtol=0)


def test_nothing_drawn_is_finite():
    empty = Gaussians.unpack(torch.zeros(0, 14))
    out = render_surfaces(graph(empty), [Posed(0, np.eye(4))])
    assert not out.alpha.any() and torch.isfinite(out.depth).all() and torch.isfinite(out.expected_depth()).all()
