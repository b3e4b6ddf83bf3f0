"""What lies on the ground stays in its plane; all else is free."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from genre_tasks.config import GnetConfig, LossConfig, PipelineConfig
from genre_tasks.optimiser.ground_constraint import compute_ground_constraint, project_onto_ground
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.state import Parameterization, State
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.render.surface import compute_normals
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC, SceneGraph
from genre_tasks.scene.rotations import multiply_quats
from tests.optimiser import street_scenes

FLAT, BALL = (0.2, 0.1, 0.01), (0.2, 0.2, 0.15)


def _about(axis: tuple[float, float, float], degrees: float) -> Tensor:
    half = math.radians(degrees) / 2
    return torch.tensor([math.cos(half), *(math.sin(half) * a for a in axis)])


def _disc(quat: Tensor, sides: tuple[float, float, float] = FLAT, node: int = STATIC) -> tuple[Tensor, Tensor, int]:
    return quat, torch.tensor(sides).log(), node


LYING = [
    _disc(_about((1, 0, 0), 0)),
    _disc(multiply_quats(_about((1, 0, 0), 20), _about((0, 0, 1), 70))),  # a slope
    _disc(-3 * _about((0, 1, 0), -10)),  # quaternions need not be unit
    _disc(_about((0, 1, 0), 90), (0.01, 0.1, 0.2)),  # its first side is the shortest
]
FREE = [
    _disc(_about((1, 0, 0), 90)),  # a wall
    _disc(_about((1, 0, 0), 40)),
    _disc(_about((1, 0, 0), 0), BALL),
    _disc(_about((1, 0, 0), 0), node=DISTANT),
    _disc(_about((1, 0, 0), 0), node=FIRST_ACTOR),
]


def _scene() -> SceneGraph:
    quats, log_scales, nodes = zip(*(LYING + FREE), strict=True)
    count = len(nodes)
    g = torch.Generator().manual_seed(0)
    full = street_scenes.scene()
    gaussians = Gaussians(
        torch.randn(count, 3, generator=g),
        torch.stack(log_scales),
        torch.stack(quats),
        torch.zeros(count),
        torch.rand(count, 3, generator=g),
    )
    actors: tuple[ActorNode, ...] = full.actors
    return SceneGraph(gaussians, torch.tensor(nodes), actors)


@pytest.mark.parametrize("compiled", [True, False])
def test_the_ground_moves_and_turns_in_its_plane_and_all_else_as_it_is_told(compiled: bool) -> None:
    scene = _scene()
    parameterization, lying = Parameterization.from_scene(scene), len(LYING)
    across = compute_normals(scene.gaussians.activate())
    state = State.zeros(len(scene), scene.gaussians.means).accumulate(torch.ones(len(scene), 14))
    g = torch.Generator().manual_seed(1)
    for _ in range(30):
        delta = 0.02 * torch.randn(len(scene), 14, generator=g)
        after = state.apply_step(parameterization, delta if compiled else delta.requires_grad_())
        assert torch.equal(after.offsets[lying:], state.offsets[lying:] + delta[lying:])
        state = replace(after, offsets=after.offsets.detach())
    moved = parameterization.gaussians_at(state.offsets)
    turned = compute_normals(replace(moved, log_scales=scene.gaussians.log_scales).activate())
    torch.testing.assert_close(turned[:lying], across[:lying], atol=2e-6, rtol=0)
    way = moved.means - scene.gaussians.means
    assert float((way * across).sum(1)[:lying].abs().max()) < 1e-6
    assert bool((way[:lying].norm(dim=1) > 1e-3).all())  # but they do move


def test_the_compiled_step_along_the_ground_is_torchs() -> None:
    scene = _scene()
    parameterization = Parameterization.from_scene(scene)
    state = State.zeros(len(scene), scene.gaussians.means).accumulate(torch.ones(len(scene), 14))
    delta = torch.randn(len(scene), 14, generator=torch.Generator().manual_seed(2))
    ours, torchs = (
        state.apply_step(parameterization, delta),
        state.apply_step(parameterization, delta.clone().requires_grad_()),
    )
    torch.testing.assert_close(ours.offsets, torchs.offsets.detach(), atol=1e-6, rtol=1e-6)
    assert torch.equal(ours.offsets[len(LYING) :], torchs.offsets[len(LYING) :].detach())


def test_only_flat_static_gaussians_that_lie_are_ground_and_only_where_asked_for() -> None:
    planes = compute_ground_constraint(_scene())
    assert (planes != 0).any(1).tolist() == [True] * len(LYING) + [False] * len(FREE)
    assert not Parameterization.from_scene(_scene(), constrain_ground=False).ground_constraint.any()


def test_a_turn_in_the_plane_and_a_longer_quaternion_are_left_as_they_are() -> None:
    scene, planes = _scene(), compute_ground_constraint(_scene())
    delta = torch.zeros(len(scene), 14)
    delta[:, 6:10] = 0.1 * planes[:, 7:] + 0.2 * scene.gaussians.quats
    torch.testing.assert_close(project_onto_ground(delta, planes), delta, atol=1e-6, rtol=0)


def test_what_leads_along_the_ground_has_gradients() -> None:
    planes = compute_ground_constraint(_scene()).double()
    delta = torch.randn(len(planes), 14, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d: project_onto_ground(d, planes), (delta,))
    twice = project_onto_ground(project_onto_ground(delta, planes), planes)
    torch.testing.assert_close(twice, project_onto_ground(delta, planes), atol=1e-6, rtol=0)


def test_a_run_may_leave_the_ground_free() -> None:
    assert GnetConfig().constrain_ground and PipelineConfig().enet.constrain_ground
    scene = street_scenes.scene(actor=False)
    log_scales, quats = torch.tensor(FLAT).log().repeat(300, 1), torch.tensor([1.0, 0, 0, 0]).repeat(300, 1)
    start = scene.with_gaussians(replace(scene.gaussians, log_scales=log_scales, quats=quats))
    objective = Objective(LossConfig(perceptual=0, depth=0))

    def height(hold: bool) -> Tensor:
        settings = UnrollSettings(4, 4, constrain_ground=hold)
        return unroll(TunedAdam(), start, street_scenes.targets(scene), (), objective, settings).scene.gaussians.means[
            :, 2
        ]

    static = start.nodes == STATIC
    assert torch.equal(height(True)[static], start.gaussians.means[static, 2])
    assert bool((height(False)[static] != start.gaussians.means[static, 2]).any())
