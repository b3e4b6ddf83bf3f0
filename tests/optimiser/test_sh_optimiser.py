"""Harmonics in the unrolled optimisation: the pass's gradient, the step, and that without them there is nothing."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from genre_tasks.config import LossConfig
from genre_tasks.losses.ssim import SsimTarget
from genre_tasks.optimiser.differentiable_render import Beside, CompiledPass, TorchPass
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.sh_optimiser import RATE, GlossSight, GlossState
from genre_tasks.optimiser.state import Frame
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import Plan, unroll
from genre_tasks.render import RenderSettings, render_views
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.spherical_harmonics import starting
from tests.optimiser import street_scenes
from tests.optimiser.test_posing import _offsets, _scene

SETTINGS = RenderSettings()


def _glossy(scene: SceneGraph, size: float = 0.3) -> SceneGraph:
    g = torch.Generator().manual_seed(8)
    return scene.with_harmonics(size * torch.randn(len(scene), 3, 3, generator=g))


def test_a_whole_pass_is_torchs() -> None:
    scene = _glossy(_scene())
    views = [
        replace(t, frame=f) for t, f in zip(street_scenes.targets(street_scenes.scene()), (1, 7, 1, 2), strict=True)
    ]
    offsets, harmonics = _offsets(scene), scene.harmonics
    fixed = Frame.of(scene), offsets, views, SETTINGS, Beside(harmonics=harmonics)
    ours, torchs = (p(*fixed) for p in (CompiledPass, TorchPass))
    torch.testing.assert_close(ours.color, torchs.color, atol=2e-4, rtol=0)
    plain = CompiledPass(Frame.of(scene), offsets, views, SETTINGS)
    assert (plain.color - ours.color).abs().max() > 0.05
    generator = torch.Generator().manual_seed(5)
    by = [torch.randn(x.shape, generator=generator) for x in (ours.color, ours.depth)]
    grads = [p.gradient(by[0].clone(), by[1].clone()) for p in (ours, torchs)]
    assert ours.gloss is not None and torchs.gloss is not None
    pairs = [grads, *zip(vars(ours.gloss).values(), vars(torchs.gloss).values(), strict=True)]
    for mine, exact in pairs:
        assert mine.shape == exact.shape and float((mine - exact).norm() / exact.norm()) < 2e-3
    assert 0 < float(ours.gloss.views.max()) <= 4
    plain.gradient(by[0].clone(), by[1].clone())
    assert plain.gloss is None


def test_an_unrolled_optimisation_learns_gloss_at_any_number_of_threads() -> None:
    truth = _glossy(_scene(600))
    views = street_scenes.targets(truth)
    with torch.no_grad():
        images = render_views(truth, views).color
    views = [replace(v, image=SsimTarget.of(i.contiguous())) for v, i in zip(views, images, strict=True)]
    begun = starting(truth.with_harmonics(None))
    objective, plan = Objective(LossConfig(perceptual=0, depth=0)), Plan(12, 3, snapshots=2)
    rule = TunedAdam((0.0, 0.0, 0.0, 0.0, 0.02))
    still = unroll(rule, begun.with_harmonics(None), views, (), objective, plan)
    ours = unroll(rule, begun, views, (), objective, plan)
    assert still.losses[0] == pytest.approx(ours.losses[0], rel=0.02)
    assert ours.losses[-1] < still.losses[-1]
    learnt = ours.scene.harmonics
    assert learnt is not None and learnt.any()
    assert torch.equal(ours.scene.gaussians.packed()[:, :11], begun.gaussians.packed()[:, :11])
    assert all(s.harmonics is not None for s in ours.snapshots.values())
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        again = unroll(rule, begun, views, (), objective, plan)
    finally:
        torch.set_num_threads(threads)
    assert again.scene.harmonics is not None and torch.equal(again.scene.harmonics, learnt)


def _sight(gradient: Tensor, mean: float) -> GlossSight:
    """Two views saw each Gaussian, in directions where the mean of each harmonic is ``mean``."""
    return GlossSight(gradient, torch.full((3, 3, 3), 2 * mean), torch.full((3, 3), 2.0))


def test_a_step_moves_what_is_seen_and_no_farther_than_its_rate() -> None:
    state, gradient = GlossState.start(torch.zeros(3, 3, 3)), torch.zeros(3, 3, 3)
    by_colors = torch.tensor([1e-3, 0.0, 1e4])[:, None].expand(3, 3)
    gradient[0, 0], gradient[2] = 0.5e-3, 0.5e4 * torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).sign()
    moved, shift = state.moved(_sight(gradient, 0.0), by_colors, 0.5)
    assert not moved.harmonics[1].any() and moved.seen[:, 0, 0].tolist() == [1.0, 0.0, 1.0]
    assert (moved.harmonics[0, 0] < 0).all() and not moved.harmonics[0, 1:].any() and not shift.any()
    torch.testing.assert_close(moved.harmonics[2].abs(), torch.full((3, 3), 0.25 * RATE))
    rest, _ = moved.moved(_sight(torch.zeros(3, 3, 3), 0.0), torch.zeros(3, 3), 1.0)
    assert torch.equal(rest.harmonics, moved.harmonics)


def test_what_all_views_ask_for_is_left_to_the_colour() -> None:
    """A gradient that is the same in each view moves no harmonics; another leaves the views' mean colour as it is."""
    by_colors, state = torch.full((3, 3), 0.7), GlossState.start(torch.zeros(3, 3, 3))
    moved, shift = state.moved(_sight(torch.full((3, 3, 3), 0.3 * 0.7), 0.3), by_colors, 1.0)
    assert moved.harmonics.abs().max() < 1e-3 * RATE and shift.abs().max() < 1e-3 * RATE
    generator = torch.Generator().manual_seed(2)
    moved, shift = state.moved(_sight(torch.randn(3, 3, 3, generator=generator), 0.3), by_colors, 1.0)
    assert moved.harmonics.abs().max() > 0.1 * RATE
    torch.testing.assert_close(shift + 0.3 * moved.harmonics.sum(1), torch.zeros(3, 3), atol=1e-7, rtol=0)


def test_without_harmonics_nothing_of_them_is_imported() -> None:
    code = (
        "import sys, torch\n"
        "from genre_tasks.config import LossConfig\n"
        "from genre_tasks.optimiser.tuned_adam import TunedAdam\n"
        "from genre_tasks.optimiser.objective import Objective\n"
        "from genre_tasks.optimiser.unroll import Plan, unroll\n"
        "from tests.optimiser import street_scenes\n"
        "s = street_scenes.scene()\n"
        "done = unroll(TunedAdam(), s, street_scenes.targets(s), (), Objective(LossConfig(perceptual=0)), Plan(2, 2))\n"
        "assert done.scene.harmonics is None\n"
        "loaded = [n for n in sys.modules if n.endswith(('harmonics', 'sh_optimiser'))]\n"
        "assert not loaded, loaded\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
