"""Harmonics in the unrolled optimisation: the pass's gradient, the step, and that without them there is nothing."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from genre_tasks.config import LossConfig
from genre_tasks.optimiser.adam import TunedAdam
from genre_tasks.optimiser.gloss import RATE, GlossState
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.passes import CompiledPass, TorchPass
from genre_tasks.optimiser.ssim import SsimTarget
from genre_tasks.optimiser.state import Frame
from genre_tasks.optimiser.unroll import Plan, unroll
from genre_tasks.render import RenderSettings, render_views
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.harmonics import starting
from tests.optimiser import street
from tests.optimiser.test_posing import _offsets, _scene

SETTINGS = RenderSettings()


def _glossy(scene: SceneGraph, size: float = 0.3) -> SceneGraph:
    g = torch.Generator().manual_seed(8)
    return scene.with_harmonics(size * torch.randn(len(scene), 3, 3, generator=g))


def test_a_whole_pass_is_torchs() -> None:
    scene = _glossy(_scene())
    views = [replace(t, frame=f) for t, f in zip(street.targets(street.scene()), (1, 7, 1, 2), strict=True)]
    offsets, harmonics = _offsets(scene), scene.harmonics
    ours, torchs = (p(Frame.of(scene), offsets, views, SETTINGS, harmonics) for p in (CompiledPass, TorchPass))
    torch.testing.assert_close(ours.color, torchs.color, atol=2e-4, rtol=0)
    plain = CompiledPass(Frame.of(scene), offsets, views, SETTINGS)
    assert (plain.color - ours.color).abs().max() > 0.05
    generator = torch.Generator().manual_seed(5)
    by = [torch.randn(x.shape, generator=generator) for x in (ours.color, ours.depth)]
    grads = [p.gradient(by[0].clone(), by[1].clone()) for p in (ours, torchs)]
    for mine, exact in zip((grads[0], ours.by_harmonics), (grads[1], torchs.by_harmonics), strict=True):
        assert mine is not None and exact is not None
        assert float((mine - exact).norm() / exact.norm()) < 1e-3
    plain.gradient(by[0].clone(), by[1].clone())
    assert plain.by_harmonics is None


def test_an_unrolled_optimisation_learns_gloss_at_any_number_of_threads() -> None:
    truth = _glossy(_scene(600))
    views = street.targets(truth)
    with torch.no_grad():
        images = render_views(truth, views).color
    views = [replace(v, image=SsimTarget.of(i.contiguous())) for v, i in zip(views, images, strict=True)]
    begun = starting(truth.with_harmonics(None))
    objective, plan = Objective(LossConfig(perceptual=0, depth=0)), Plan(12, 3, snapshots=2)
    still = unroll(TunedAdam((0.0,) * 5), begun.with_harmonics(None), views, (), objective, plan)
    ours = unroll(TunedAdam((0.0,) * 5), begun, views, (), objective, plan)
    assert still.losses[0] == pytest.approx(ours.losses[0], rel=0.02)
    assert ours.losses[-1] < 0.9 * still.losses[-1]
    learnt = ours.scene.harmonics
    assert learnt is not None and truth.harmonics is not None
    assert torch.equal(ours.scene.gaussians.packed(), begun.gaussians.packed())
    assert float(torch.cosine_similarity(learnt.flatten(), truth.harmonics.flatten(), 0)) > 0.1
    assert all(s.harmonics is not None for s in ours.snapshots.values())
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        again = unroll(TunedAdam((0.0,) * 5), begun, views, (), objective, plan)
    finally:
        torch.set_num_threads(threads)
    assert again.scene.harmonics is not None and torch.equal(again.scene.harmonics, learnt)


def test_a_step_moves_what_is_seen_and_no_farther_than_its_rate() -> None:
    state = GlossState.start(torch.zeros(3, 3, 3))
    gradient = torch.zeros(3, 3, 3)
    gradient[0, 0], gradient[2] = 1e-3, 1e4 * torch.randn(3, 3, generator=torch.Generator().manual_seed(1))
    moved = state.moved(gradient, 0.5)
    assert not moved.harmonics[1].any() and moved.seen[:, 0, 0].tolist() == [1.0, 0.0, 1.0]
    assert (moved.harmonics[0, 0] < 0).all() and not moved.harmonics[0, 1:].any()
    assert 0 < float(moved.harmonics.abs().max()) <= 0.5 * RATE * 3 + 1e-6  # a gradient in one of 9: √9 times the mean
    rest = moved.moved(torch.zeros(3, 3, 3), 1.0)
    assert torch.equal(rest.harmonics, moved.harmonics)


def test_without_harmonics_nothing_of_them_is_imported() -> None:
    code = (
        "import sys, torch\n"
        "from genre_tasks.config import LossConfig\n"
        "from genre_tasks.optimiser.adam import TunedAdam\n"
        "from genre_tasks.optimiser.objective import Objective\n"
        "from genre_tasks.optimiser.unroll import Plan, unroll\n"
        "from tests.optimiser import street\n"
        "s = street.scene()\n"
        "done = unroll(TunedAdam(), s, street.targets(s), (), Objective(LossConfig(perceptual=0)), Plan(2, 2))\n"
        "assert done.scene.harmonics is None\n"
        "loaded = [n for n in sys.modules if n.endswith(('harmonics', 'gloss'))]\n"
        "assert not loaded, loaded\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
