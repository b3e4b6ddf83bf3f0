"""Hard cases 11–16: opacities at their limits, many layers, gradients beside thresholds, empty pixels, half inputs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from genre_tasks.render import Cameras, render
from genre_tasks.render import constants as const
from genre_tasks.scene.gaussians import Splats
from tests.hard_cases.case_measurements import ALPHA_BOUND, DIFFERENCES, HALF, NO_WEIGHT
from tests.hard_cases.comparison import REFERENCE, SETTINGS, assert_matches_float64, on_all, on_both, worst
from tests.hard_cases.render_cases import COMPOSITING, layers
from tests.render.oracles import agreement, alpha_excess, survey
from tests.scenes import NAMES, Scene, cloud, gradients, street


@on_all
@pytest.mark.parametrize("case", COMPOSITING, ids=lambda c: f"{c.number} {c.words}")
def test_against_float64(case, backend, stability):
    assert_matches_float64(case, backend, stability)


def _stack(opacities: list[float], size_px: float) -> Scene:
    """Layers a metre apart about the middle of 9 × 9 px, of about ``size_px`` standard deviation."""
    g = torch.Generator().manual_seed(2)
    n = len(opacities)
    z = 5.0 + torch.arange(n)
    means = torch.cat([0.05 * torch.randn(n, 2, generator=g), z[:, None]], 1)
    scales = size_px / 20 * z[:, None] * torch.tensor([[1.0, 0.8, 0.9]])
    splats = Splats(
        means, scales, torch.randn(n, 4, generator=g), torch.tensor(opacities), torch.rand(n, 3, generator=g)
    )
    return splats, Cameras(torch.eye(4)[None], torch.full((1, 2), 20.0), torch.full((1, 2), 4.5), 9, 9)


STACKS = {"clamp": ([1.0, 0.985, 0.6], 20.0), "stop": ([0.9, 0.9, 0.9, 0.88, 0.5], 12.0)}


def _differences(splats: Splats, cameras: Cameras, mask: Tensor, step: float = 1e-6) -> dict[str, Tensor]:
    """The gradient that ``gradients`` takes of the float64 reference, by central differences of its weighted sum."""
    g = torch.Generator().manual_seed(1)
    shape = (1, cameras.height_px, cameras.width_px)
    weights = (
        torch.randn(*shape, 3, generator=g),
        torch.randn(shape, generator=g),
        torch.randn(shape, generator=g) / 20,
    )

    def loss(moved: Splats) -> float:
        out = render(moved, cameras, REFERENCE)
        images = (out.color * mask[..., None], out.alpha * mask, out.depth * mask)
        return float(sum((w.double() * i).sum() for w, i in zip(weights, images, strict=True)))

    exact = splats.to(torch.float64)
    found = {}
    for name in NAMES:
        values = getattr(exact, name)
        slope = torch.zeros_like(values)
        for i in range(values.numel()):
            sides = []
            for sign in (1, -1):
                moved = values.clone()
                moved.view(-1)[i] += sign * step
                sides.append(loss(replace(exact, **{name: moved})))
            slope.view(-1)[i] = (sides[0] - sides[1]) / (2 * step)
        found[name] = slope
    return found


@on_both
@pytest.mark.parametrize("what", STACKS)
def test_gradients_beside_a_threshold(backend, what, stability):
    splats, cameras = _stack(*STACKS[what])
    seen = survey(splats, cameras, margin=1e-3)
    smooth = ~seen.band
    _, found = gradients(splats, cameras, SETTINGS[backend], mask=smooth)
    if what == "clamp":
        beyond = seen.peak >= const.ALPHA_MAX
    else:
        without = Splats(*(getattr(splats, n)[:-1] for n in NAMES))
        beyond = render(without, cameras, REFERENCE).alpha == render(splats, cameras, REFERENCE).alpha
    # Both sides of the threshold are there.
    assert int((beyond & smooth).sum()) > 8 and int((~beyond & smooth).sum()) > 8
    stability.record(DIFFERENCES[what], backend, worst(found, _differences(splats, cameras, smooth)))


@on_both
def test_alpha_is_bounded_by_equal_layers(backend, stability):
    for splats, cameras in (cloud(2000, views=2), street(3000, 96, 64), layers(30_000, 0.005), layers(3, 0.2)):
        alpha = render(splats, cameras, SETTINGS[backend]).alpha
        stability.record(ALPHA_BOUND, backend, max(0.0, alpha_excess(alpha, survey(splats, cameras))))
    assert float(alpha[0, 4, 4]) == pytest.approx(1 - 0.8**3, abs=1e-3)  # nearly flat layers reach the bound


@on_both
def test_depth_without_weight_is_zero_without_gradient(backend, stability):
    splats, cameras = cloud(20, 33, 17)
    splats = replace(splats, scales=splats.scales * 0.05)
    leaves = [getattr(splats, n).clone().requires_grad_() for n in NAMES]
    out = render(Splats(*leaves), cameras, SETTINGS[backend])
    depth, empty = out.expected_depth(), out.alpha == 0
    assert 0.1 < float(empty.double().mean()) < 0.9 and bool((depth[~empty] > 1).all())
    slopes = torch.autograd.grad(depth[empty].sum(), leaves, retain_graph=True)
    stability.record(NO_WEIGHT, backend, max(float(x.detach().abs().max()) for x in (depth[empty], *slopes)))
    assert all(bool(g.isfinite().all()) for g in torch.autograd.grad(depth.sum(), leaves))


@pytest.mark.parametrize("name", HALF)
def test_half_precision_in_float32_out(name, stability):
    splats, cameras = cloud(300)
    dtype = getattr(torch, name)
    rounded = splats.to(dtype)
    out, found = gradients(rounded, cameras, SETTINGS["cpu"], dtype)
    same, expected = gradients(rounded.to(torch.float32), cameras, SETTINGS["cpu"])
    assert out.color.dtype == torch.float32 and torch.equal(out.color, same.color)
    assert all(found[n].dtype == dtype and torch.equal(found[n], expected[n].to(dtype)) for n in NAMES)
    truth = render(rounded.to(torch.float64), cameras, REFERENCE)
    stability.record(HALF[name], "cpu", agreement(out, truth, survey(rounded, cameras).band).outside)
