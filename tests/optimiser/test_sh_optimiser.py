"""Harmonics in the unrolled optimisation: the pass's gradient, the step, and that without them there is nothing."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from genre_tasks.config import LearningRates, LossConfig
from genre_tasks.losses.ssim import SsimTarget
from genre_tasks.optimiser.autograd_render import AutogradRender
from genre_tasks.optimiser.auxiliary import AuxiliaryParameters
from genre_tasks.optimiser.gradients import ShGradients
from genre_tasks.optimiser.kernel_render import KernelRender
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.sh_optimiser import LEARNING_RATE, ShState
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.render import RenderSettings, render_views
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.spherical_harmonics import with_zero_spherical_harmonics
from tests.optimiser import street_scenes
from tests.optimiser.test_posing import _offsets, _scene

SETTINGS = RenderSettings()


def _glossy(scene: SceneGraph, size: float = 0.3) -> SceneGraph:
    g = torch.Generator().manual_seed(8)
    return scene.with_spherical_harmonics(size * torch.randn(len(scene), 3, 3, generator=g))


def test_a_whole_pass_is_torchs() -> None:
    scene = _glossy(_scene())
    views = [
        replace(t, frame=f) for t, f in zip(street_scenes.targets(street_scenes.scene()), (1, 7, 1, 2), strict=True)
    ]
    offsets, spherical_harmonics = _offsets(scene), scene.spherical_harmonics
    fixed = (
        Parameterization.from_scene(scene),
        offsets,
        views,
        SETTINGS,
        AuxiliaryParameters(spherical_harmonics=spherical_harmonics),
    )
    ours, torchs = (p(*fixed) for p in (KernelRender, AutogradRender))
    torch.testing.assert_close(ours.color, torchs.color, atol=2e-4, rtol=0)
    plain = KernelRender(Parameterization.from_scene(scene), offsets, views, SETTINGS)
    assert (plain.color - ours.color).abs().max() > 0.05
    generator = torch.Generator().manual_seed(5)
    by = [torch.randn(x.shape, generator=generator) for x in (ours.color, ours.depth)]
    found, expected = (p.gradient(by[0].clone(), by[1].clone()) for p in (ours, torchs))
    assert found.spherical_harmonics is not None and expected.spherical_harmonics is not None
    names = ("coefficients", "basis_sums", "view_counts")
    pairs = [(getattr(found.spherical_harmonics, n), getattr(expected.spherical_harmonics, n)) for n in names]
    pairs.append((found.gaussians, expected.gaussians))
    for mine, exact in pairs:
        assert mine.shape == exact.shape and float((mine - exact).norm() / exact.norm()) < 2e-3
    assert 0 < float(found.spherical_harmonics.view_counts.max()) <= 4
    assert plain.gradient(by[0].clone(), by[1].clone()).spherical_harmonics is None


def test_an_unrolled_optimisation_learns_gloss_at_any_number_of_threads() -> None:
    # The kernels give each thread 512 Gaussians at least, so fewer would stay on one thread.
    truth = _glossy(_scene(1600))
    views = street_scenes.targets(truth)
    with torch.no_grad():
        images = render_views(truth, views).color
    views = [replace(v, image=SsimTarget.from_image(i.contiguous())) for v, i in zip(views, images, strict=True)]
    begun = with_zero_spherical_harmonics(truth.with_spherical_harmonics(None))
    objective, settings = Objective(LossConfig(perceptual=0, depth=0)), UnrollSettings(12, 3, snapshots=2)
    rule = TunedAdam(LearningRates.from_sequence((0.0, 0.0, 0.0, 0.0, 0.02)))
    still = unroll(rule, begun.with_spherical_harmonics(None), views, (), objective, settings)
    ours = unroll(rule, begun, views, (), objective, settings)
    assert still.losses[0] == pytest.approx(ours.losses[0], rel=0.02)
    assert ours.losses[-1] < still.losses[-1]
    learnt = ours.scene.spherical_harmonics
    assert learnt is not None and learnt.any()
    assert torch.equal(ours.scene.gaussians.pack()[:, :11], begun.gaussians.pack()[:, :11])
    assert all(s.spherical_harmonics is not None for s in ours.snapshots.values())
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        again = unroll(rule, begun, views, (), objective, settings)
    finally:
        torch.set_num_threads(threads)
    assert again.scene.spherical_harmonics is not None and torch.equal(again.scene.spherical_harmonics, learnt)


def _gradients(gradient: Tensor, mean: float) -> ShGradients:
    """Two views saw each Gaussian, in directions where the mean of each harmonic is ``mean``."""
    return ShGradients(gradient, torch.full((3, 3, 3), 2 * mean), torch.full((3, 3), 2.0))


def test_a_step_moves_what_is_seen_and_no_farther_than_its_rate() -> None:
    state, gradient = ShState.from_coefficients(torch.zeros(3, 3, 3)), torch.zeros(3, 3, 3)
    by_colors = torch.tensor([1e-3, 0.0, 1e4])[:, None].expand(3, 3)
    gradient[0, 0], gradient[2] = 0.5e-3, 0.5e4 * torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).sign()
    moved, shift = state.apply_step(_gradients(gradient, 0.0), by_colors, 0.5)
    assert not moved.coefficients[1].any() and moved.visit_count[:, 0, 0].tolist() == [1.0, 0.0, 1.0]
    assert (moved.coefficients[0, 0] < 0).all() and not moved.coefficients[0, 1:].any() and not shift.any()
    torch.testing.assert_close(moved.coefficients[2].abs(), torch.full((3, 3), 0.25 * LEARNING_RATE))
    rest, _ = moved.apply_step(_gradients(torch.zeros(3, 3, 3), 0.0), torch.zeros(3, 3), 1.0)
    assert torch.equal(rest.coefficients, moved.coefficients)


@pytest.mark.parametrize("sh_count", [3, 8, 15])
def test_the_kernels_steps_are_torchs(sh_count: int) -> None:
    g = torch.Generator().manual_seed(sh_count)
    ours = exact = ShState.from_coefficients(0.1 * torch.randn(500, sh_count, 3, generator=g))
    for iteration in range(5):
        # Gaussians come and go; some are never seen, and gradients have many sizes.
        seen = (torch.rand(500, 1, generator=g) < 0.7) & (torch.arange(500)[:, None] >= 20)
        size = 10.0 ** torch.randint(-9, 5, (500, 1), generator=g)
        by_colors = torch.randn(500, 3, generator=g) * size * seen
        counts = torch.randint(0, 4, (500, 1), generator=g).expand(500, 3) * seen
        basis_sums = torch.randn(500, sh_count, 3, generator=g) * counts[:, None]
        gradients = ShGradients(basis_sums * by_colors[:, None], basis_sums, counts.float())
        ours, shift = ours.apply_step(gradients, by_colors, 1 - iteration / 5)
        exact, exact_shift = exact.apply_torch_step(gradients, by_colors, 1 - iteration / 5)
        torch.testing.assert_close(shift, exact_shift, atol=1e-6, rtol=1e-4)
        for name in ("visit_count", "view_counts", "basis_sums"):
            assert torch.equal(getattr(ours, name), getattr(exact, name))
        torch.testing.assert_close(ours.coefficients, exact.coefficients, atol=1e-6, rtol=1e-4)
        torch.testing.assert_close(ours.second_moment, exact.second_moment, atol=0, rtol=1e-5)
    with pytest.raises(ValueError, match="expected float32"):
        ours.apply_step(replace(gradients, view_counts=counts[1:].float()), by_colors, 1.0)


def test_what_all_views_ask_for_is_left_to_the_colour() -> None:
    """A gradient that is the same in each view moves no harmonics; another leaves the views' mean colour as it is."""
    by_colors, state = torch.full((3, 3), 0.7), ShState.from_coefficients(torch.zeros(3, 3, 3))
    moved, shift = state.apply_step(_gradients(torch.full((3, 3, 3), 0.3 * 0.7), 0.3), by_colors, 1.0)
    assert moved.coefficients.abs().max() < 1e-3 * LEARNING_RATE and shift.abs().max() < 1e-3 * LEARNING_RATE
    generator = torch.Generator().manual_seed(2)
    moved, shift = state.apply_step(_gradients(torch.randn(3, 3, 3, generator=generator), 0.3), by_colors, 1.0)
    assert moved.coefficients.abs().max() > 0.1 * LEARNING_RATE
    torch.testing.assert_close(shift + 0.3 * moved.coefficients.sum(1), torch.zeros(3, 3), atol=1e-7, rtol=0)


def test_without_harmonics_nothing_of_them_is_imported() -> None:
    code = (
        "import sys, torch\n"
        "from genre_tasks.config import LossConfig\n"
        "from genre_tasks.optimiser.tuned_adam import TunedAdam\n"
        "from genre_tasks.optimiser.objective import Objective\n"
        "from genre_tasks.optimiser.unroll import UnrollSettings, unroll\n"
        "from tests.optimiser import street_scenes\n"
        "s = street_scenes.scene()\n"
        "objective = Objective(LossConfig(perceptual=0))\n"
        "done = unroll(TunedAdam(), s, street_scenes.targets(s), (), objective, UnrollSettings(2, 2))\n"
        "assert done.scene.spherical_harmonics is None\n"
        "loaded = [n for n in sys.modules if n.endswith(('harmonics', 'sh_optimiser'))]\n"
        "assert not loaded, loaded\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
