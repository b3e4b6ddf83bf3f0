"""Density control: which Gaussians are cloned, split, pruned and reset, and that nodes and moments follow."""

from __future__ import annotations

import math

import pytest
import torch

from genre_tasks.config import DensityConfig
from genre_tasks.per_scene import densification
from genre_tasks.per_scene.densification import GaussiansWithMoments
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC

CONFIG = DensityConfig()
SMALL, LARGE = math.log(0.05), math.log(0.5)
"""Either side of 1 % of the extent, 10 m."""


def _population(
    log_scales: list[float], nodes: list[int] | None = None, opacity: float | list[float] = 0.5
) -> GaussiansWithMoments:
    """Remembering moments of one everywhere."""
    n = len(log_scales)
    quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=torch.Generator().manual_seed(1)), dim=1)
    opacities = torch.as_tensor(opacity).expand(n)
    g = Gaussians(
        torch.arange(3.0 * n).view(n, 3),
        torch.tensor(log_scales)[:, None].repeat(1, 3),
        quats,
        torch.log(opacities / (1 - opacities)),
        torch.full((n, 3), 0.3),
    )
    ones = map_attributes(torch.ones_like, g)
    return GaussiansWithMoments(g, ones, ones, torch.tensor(nodes or [STATIC] * n))


def _grown(
    population: GaussiansWithMoments, screen_gradient: list[float], config: DensityConfig = CONFIG, seed: int = 0
) -> GaussiansWithMoments:
    extent = torch.full((len(population),), 10.0)
    return densification.densify(
        population, torch.tensor(screen_gradient), extent, config, torch.Generator().manual_seed(seed)
    )


def test_large_gradients_clone_small_gaussians_and_split_large_ones() -> None:
    before = _population([SMALL, SMALL, LARGE, LARGE])
    after = _grown(before, [1e-5, 1e-3, 1e-5, 1e-3])
    assert len(after) == 6
    packed = after.gaussians.pack()
    assert torch.equal(packed[:3], before.gaussians.pack()[:3])  # the fourth went into its halves
    assert torch.equal(packed[3], before.gaussians.pack()[1])
    assert torch.allclose(after.gaussians.log_scales[4:].exp(), torch.tensor(0.5 / 1.6))
    assert not torch.equal(packed[4], packed[5])
    assert float((after.gaussians.means[4:] - before.gaussians.means[3]).abs().max()) < 4 * 0.5
    assert torch.equal(packed[4:, 6:], before.gaussians.pack()[3:, 6:].repeat(2, 1))


def test_the_new_have_no_memory_and_the_old_keep_theirs() -> None:
    after = _grown(_population([SMALL, LARGE, SMALL]), [1e-3, 1e-3, 0.0])
    for moments in (after.first_moments, after.second_moments):
        assert moments.pack().mean(1).tolist() == [1, 1, 0, 0, 0]


def test_halves_are_drawn_from_their_parent() -> None:
    """A thousand thin parents along a turned axis: mean and covariance of their halves are the parents'."""
    n, turn = 1000, math.pi / 6
    g = Gaussians(
        torch.zeros(n, 3),
        torch.log(torch.tensor([2.0, 0.2, 0.2])).repeat(n, 1),
        torch.tensor([math.cos(turn), 0.0, 0.0, math.sin(turn)]).repeat(n, 1),
        torch.zeros(n),
        torch.zeros(n, 3),
    )
    parents = GaussiansWithMoments.with_zero_moments(g, torch.full((n,), STATIC))
    halves = _grown(parents, [1.0] * n).gaussians.means
    assert len(halves) == 2 * n
    axis = torch.tensor([math.cos(2 * turn), math.sin(2 * turn), 0.0])
    assert float((halves @ axis).std()) == pytest.approx(2.0, rel=0.08)
    assert float((halves @ torch.tensor([-axis[1], axis[0], 0.0])).std()) == pytest.approx(0.2, rel=0.08)


def test_children_belong_to_their_parents_node_and_the_distant_keep_their_number() -> None:
    nodes = [STATIC, DISTANT, FIRST_ACTOR, FIRST_ACTOR + 1]
    after = _grown(_population([SMALL, SMALL, SMALL, LARGE], nodes), [1.0] * 4)
    assert after.nodes.tolist() == [STATIC, DISTANT, FIRST_ACTOR, STATIC, FIRST_ACTOR, *[FIRST_ACTOR + 1] * 2]


def test_size_is_measured_by_the_nodes_own_extent() -> None:
    population = _population([SMALL, SMALL], [STATIC, FIRST_ACTOR])
    after = densification.densify(population, torch.ones(2), torch.tensor([10.0, 3.0]), CONFIG, torch.Generator())
    assert after.nodes.tolist() == [STATIC, STATIC, FIRST_ACTOR, FIRST_ACTOR]  # cloned; split
    assert bool((after.gaussians.log_scales[2:] < SMALL).all())


@pytest.mark.parametrize(("bound", "count"), [(4, 4), (6, 6), (8, 8), (100, 8), (2, 4)])
def test_the_bound_lets_the_largest_gradients_in_first(bound: int, count: int) -> None:
    config = CONFIG.model_copy(update={"max_gaussians": bound})
    after = _grown(_population([SMALL] * 4), [0.1, 0.4, 0.3, 0.2], config)
    assert len(after) == count
    clones = after.gaussians.means[4:, 0].tolist()
    assert clones == sorted([3.0, 6.0, 9.0, 0.0][: max(count - 4, 0)])


def test_the_transparent_go_and_the_too_large_when_asked() -> None:
    huge = math.log(1.5)
    population = _population([SMALL, SMALL, huge, huge, SMALL], [0, 0, 0, 1, 1], [0.5, 0.004, 0.5, 0.5, 0.001])
    extent = torch.full((5,), 10.0)
    assert densification.prune(population, extent, CONFIG, too_large=False).nodes.tolist() == [0, 0, 1, 1]
    left = densification.prune(population, extent, CONFIG, too_large=True)
    assert left.gaussians.means[:, 0].tolist() == [0.0, 9.0, 12.0]


def test_a_reset_lowers_opacities_and_forgets_their_moments_alone() -> None:
    after = densification.reset_opacity(_population([SMALL] * 3, [0, 0, 1], [0.5, 0.007, 0.5]), CONFIG)
    assert after.gaussians.activate().opacities.tolist() == pytest.approx([0.01, 0.007, 0.5])
    assert after.first_moments.logit_opacities.tolist() == [0, 0, 1] == after.second_moments.logit_opacities.tolist()
    assert bool((after.first_moments.means == 1).all())


def test_nobody_may_be_left() -> None:
    nobody = densification.prune(_population([SMALL], opacity=0.001), torch.ones(1), CONFIG, too_large=True)
    assert len(nobody) == 0 and len(_grown(nobody, [])) == 0
