"""Gaussians that are split before an optimisation."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from genre_tasks.config import LossConfig
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.residual_splitting import (
    SHRINK,
    residual_energy,
    split_along_longest_axis,
    split_by_residual,
)
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.render import render_views
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC, SceneGraph
from genre_tasks.scene.rotations import quats_to_matrices
from tests.optimiser import street_scenes

LOSS = LossConfig(perceptual=0.0)


def _recoloured(scene: SceneGraph, rows: list[int]) -> SceneGraph:
    colors = scene.gaussians.colors.clone()
    colors[rows] = 1.0 - colors[rows].round()
    return scene.with_gaussians(replace(scene.gaussians, colors=colors))


def test_halves_take_the_place_of_their_parent_along_its_longest_side() -> None:
    whole = street_scenes.scene()
    whole = whole.with_spherical_harmonics(torch.rand(len(whole), 8, 3))
    rows = torch.tensor([40, 150, 299])
    scene = split_along_longest_axis(whole, rows)
    assert len(scene) == len(whole) + 3 == len(scene.nodes)
    assert torch.equal(scene.nodes[-3:], whole.nodes[rows]) and torch.equal(scene.nodes[:-3], whole.nodes)
    assert scene.spherical_harmonics is not None and whole.spherical_harmonics is not None
    assert torch.equal(
        scene.spherical_harmonics, torch.cat([whole.spherical_harmonics, whole.spherical_harmonics[rows]])
    )
    before, after = whole.gaussians, scene.gaussians
    others = torch.ones(len(whole), dtype=torch.bool).index_fill_(0, rows, False)
    assert torch.equal(after.pack()[:-3][others], before.pack()[others])
    a, b = after.pack()[rows], after.pack()[-3:]
    assert torch.equal(a[:, 3:], b[:, 3:]) and torch.equal(a[:, 6:], before.pack()[rows][:, 6:])
    torch.testing.assert_close((a + b)[:, :3] / 2, before.means[rows])
    assert torch.equal((before.log_scales[rows] - a[:, 3:6] > 0).sum(1), torch.ones(3, dtype=torch.int64))
    longest = before.log_scales[rows].max(1)
    torch.testing.assert_close(a[:, 3:6].gather(1, longest.indices[:, None])[:, 0], longest.values - math.log(SHRINK))
    apart = torch.nn.functional.normalize(a[:, :3] - b[:, :3], dim=1)
    axes = quats_to_matrices(before.quats[rows])[torch.arange(3), :, longest.indices]
    torch.testing.assert_close((apart * axes).sum(1), torch.ones(3))


def test_those_are_split_where_images_have_more_than_the_render() -> None:
    truth = street_scenes.scene()
    views, odd = street_scenes.targets(truth), [100, 140, 180]
    assert float(residual_energy(truth, views).max()) < 1e-6
    start = _recoloured(truth, odd)
    found = residual_energy(start, views)
    seen = [k for k in odd if float(found[k]) > 0]
    assert seen and set(torch.argsort(found, descending=True)[: len(seen)].tolist()) & set(seen)
    scene = split_by_residual(start, views, 5 / len(start))
    assert len(scene) == len(start) + 5
    moved = (scene.gaussians.means[: len(start)] != start.gaussians.means).any(1).nonzero()[:, 0]
    assert set(moved.tolist()) == set(torch.argsort(found, descending=True)[:5].tolist())
    assert sorted(moved.tolist()) == moved.tolist() and torch.equal(scene.nodes[len(start) :], start.nodes[moved])


def test_the_sums_are_of_squared_differences() -> None:
    """All Gaussians' parts of a pixel are its opacity, so the parts of one view sum up to what is left, at most."""
    truth = street_scenes.scene()
    start, views = street_scenes.blurred(truth), street_scenes.targets(truth)
    with torch.no_grad():
        image = render_views(start, views)
    left = sum(
        float(((t.image.pixels - image.color[i]).square().sum(-1) * image.alpha[i]).sum()) for i, t in enumerate(views)
    )
    assert float(residual_energy(start, views).sum()) == pytest.approx(left, rel=1e-3)


def test_what_is_unseen_stays_whole() -> None:
    truth = street_scenes.scene()
    views = street_scenes.targets(truth)
    start = street_scenes.blurred(truth)
    scene = split_by_residual(start, views, 1.0)
    assert len(scene) == 2 * len(start)
    seen = residual_energy(start, views) > 0
    whole = (scene.gaussians.pack()[: len(start)] == start.gaussians.pack()).all(1)
    assert 0 < int(seen.sum()) < len(start) and bool(whole[~seen].all()) and not bool(whole[seen].all())
    assert int((scene.nodes >= FIRST_ACTOR).sum()) > int((start.nodes >= FIRST_ACTOR).sum())
    assert int((scene.nodes == DISTANT).sum()) > int((start.nodes == DISTANT).sum())
    assert split_by_residual(start, views, 0.0) is start
    assert split_by_residual(start, (), 0.5) is start
    behind = replace(start.gaussians, means=start.gaussians.means - torch.tensor([0.0, 0.0, 200.0]))
    hidden = replace(start, gaussians=behind, nodes=torch.full_like(start.nodes, STATIC), actors=())
    assert split_by_residual(hidden, views, 0.5) is hidden


def test_distant_halves_lie_beside_each_other_as_seen_from_the_path() -> None:
    scene = street_scenes.scene(60)
    # Balls all around, as a shell begins: of equal sides the first one may point at the viewer.
    directions = torch.nn.functional.normalize(torch.randn(60, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    directions[0] = torch.tensor([1.0, 0.0, 0.0])
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(60, 1)
    balls = replace(scene.gaussians, means=100 * directions, quats=quats, log_scales=torch.zeros(60, 3))
    rows = torch.arange(60)
    shell = replace(scene, gaussians=balls, nodes=torch.full((60,), DISTANT), actors=())
    split = split_along_longest_axis(shell, rows).gaussians
    apart = torch.nn.functional.normalize(split.means[:60] - split.means[60:], dim=1)
    assert float((apart * directions).sum(1).abs().max()) < 0.6
    # A near Gaussian is seen from many sides: its own longest side decides, of equal ones the first.
    near = split_along_longest_axis(replace(shell, nodes=torch.full((60,), STATIC)), rows).gaussians
    assert torch.equal(near.log_scales[:, 0], torch.full((120,), -math.log(SHRINK)))


def test_what_leaves_most_unexplained_is_split_more_than_once() -> None:
    truth = street_scenes.scene()
    views, odd = street_scenes.targets(truth), 140
    start = truth.with_gaussians(replace(truth.gaussians, log_scales=truth.gaussians.log_scales.clone()))
    start.gaussians.log_scales[odd] += 1.2
    start = _recoloured(start, [odd])
    found = residual_energy(start, views)
    assert int(found.argmax()) == odd
    scene = split_by_residual(start, views, 74 / 300)  # two rounds of 37
    alike = (scene.gaussians.colors == start.gaussians.colors[odd]).all(1)
    assert len(scene) == 374 and int(alike.sum()) == 4
    middle = scene.gaussians.means[alike].mean(0)
    torch.testing.assert_close(middle, start.gaussians.means[odd], rtol=1e-4, atol=1e-4)


def test_an_optimisation_splits_first_and_comes_nearer() -> None:
    truth = street_scenes.scene(600)
    views = street_scenes.targets(truth)
    coarse = street_scenes.blurred(truth)
    few = torch.arange(0, 600, 3)
    g = type(coarse.gaussians)(
        *(
            x[few]
            for x in (
                coarse.gaussians.means,
                coarse.gaussians.log_scales + 0.5,
                coarse.gaussians.quats,
                coarse.gaussians.logit_opacities,
                coarse.gaussians.colors,
            )
        )
    )
    start = replace(coarse, gaussians=g, nodes=coarse.nodes[few])
    rule = TunedAdam()
    whole = unroll(rule, start, views, (), Objective(LOSS), UnrollSettings(60, 4))
    split = unroll(rule, start, views, (), Objective(LOSS), UnrollSettings(60, 4, split_fraction=0.5))
    assert len(whole.scene) == 200 < len(split.scene) <= 300
    assert split.losses[-1] < 0.95 * whole.losses[-1]
    again = unroll(rule, start, views, (), Objective(LOSS), UnrollSettings(60, 4, split_fraction=0.5))
    assert torch.equal(again.scene.gaussians.pack(), split.scene.gaussians.pack())
