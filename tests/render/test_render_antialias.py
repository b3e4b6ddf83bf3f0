"""Anti-aliasing: against the float64 reference and finite differences; off it changes no bit; what it is for."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from genre_tasks.errors import ConfigError
from genre_tasks.logs.types import RollingShutter
from genre_tasks.render import Cameras, RenderSettings, constants, render
from genre_tasks.render.cuda import _camera_options
from genre_tasks.render.types import Shutter
from genre_tasks.scene.gaussians import Splats
from tests.render.oracles import agreement, relative_l2, survey
from tests.scenes import NAMES, cloud, smooth

CPU, REFERENCE = RenderSettings("cpu", 1), RenderSettings("reference")
BOTH = pytest.mark.parametrize("settings", [CPU, REFERENCE], ids=lambda s: s.backend)
BARREL = (-0.3, 0.12, 0.002, -0.0015, -0.01)
MOTION = RollingShutter(0.03, velocity_m_s=(9.0, -0.5, 14.0), turn_rad_s=(0.2, -0.5, 0.3))
KINDS = pytest.mark.parametrize("kind", ["pinhole", "lens", "shutter", "lens, shutter"])


def _kind(cameras: Cameras, kind: str) -> Cameras:
    if "lens" in kind:
        cameras = replace(cameras, distortion=torch.tensor(BARREL).repeat(len(cameras), 1))
    if "shutter" in kind:
        cameras = replace(
            cameras, shutter=Shutter.from_rolling_shutters([MOTION] * len(cameras), cameras.focal_px.dtype)
        )
    return replace(cameras, antialiased=True)


@KINDS
@pytest.mark.parametrize("size", [0.3, 0.05])
def test_values_and_gradients_against_the_reference(scene, gradients, kind, size):
    """Sizes about and well below a pixel's: most of an opacity is kept, and little of it."""
    splats, cameras = scene(300, 64, 48, views=2)
    splats, cameras = replace(splats, scales=size * splats.scales), _kind(cameras, kind)
    image, grads = gradients(splats, cameras, CPU)
    truth, exact = gradients(splats, cameras, REFERENCE, torch.float64)
    assert image.culled == truth.culled
    plain = render(splats, replace(cameras, antialiased=False), CPU)
    assert (plain.color - image.color).detach().abs().max() > 0.02
    found = agreement(image, truth, survey(splats, cameras).band)
    assert found.outside < 1e-5 and found.share < 0.03
    for name, grad in grads.items():
        assert relative_l2(grad, exact[name]) <= 2e-5, name


@KINDS
def test_reference_gradients_against_finite_differences(kind):
    splats, cameras = smooth()
    cameras = _kind(cameras, kind)
    inputs = [getattr(splats, n).requires_grad_() for n in NAMES]

    def images(*x: torch.Tensor) -> torch.Tensor:
        out = render(Splats(**dict(zip(NAMES, x, strict=True))), cameras, REFERENCE)
        return torch.cat([out.color.flatten(), out.alpha.flatten(), out.depth.flatten()])[::37]

    assert torch.autograd.gradcheck(images, inputs, eps=1e-6, atol=1e-6)


def test_gsplat_is_not_asked_for_what_it_does_not_have():
    splats, cameras = cloud(3)
    assert _camera_options(splats, replace(cameras, antialiased=True)) == {}
    with pytest.raises(ConfigError, match="no anti-aliasing with a lens distortion"):
        _camera_options(splats, _kind(cameras, "lens"))


@BOTH
def test_off_it_changes_no_bit(scene, gradients, settings):
    splats, cameras = scene(300, views=2)
    plain, grads = gradients(splats, cameras, settings)
    again, same = gradients(splats, replace(cameras, antialiased=False), settings)
    assert all(torch.equal(getattr(plain, n), getattr(again, n)) for n in ("color", "alpha", "depth"))
    assert all(torch.equal(grads[n], same[n]) for n in grads)


@BOTH
@pytest.mark.parametrize("size_px", [0.02, 0.3, 3.0])
def test_a_gaussian_keeps_its_light_at_any_size(settings, size_px):
    """The sum over pixels is that of the Gaussian without blur, 2 π o s², where the floor and the skip do not act."""
    cameras = Cameras(torch.eye(4)[None], torch.full((1, 2), 50.0), torch.full((1, 2), 16.5), 33, 33, antialiased=True)
    one = torch.ones(1)
    ball = Splats(
        torch.tensor([[0.0, 0.0, 10.0]]), one.expand(1, 3) * size_px / 5, torch.eye(4)[:1], 0.5 * one, one.expand(1, 3)
    )
    total = float(render(ball, cameras, settings).alpha.sum())
    true = 2 * torch.pi * 0.5 * size_px**2
    blurred = float(render(ball, replace(cameras, antialiased=False), settings).alpha.sum())
    if size_px < 0.1:  # lowered below one 8-bit level: nothing is drawn, and without compensation a pixel is
        assert total == 0 and blurred > 100 * true
    else:
        assert total == pytest.approx(true, rel=0.07) and blurred > total


@BOTH
@pytest.mark.parametrize("thin", [0.0, 1e-6, 1e-3])
def test_thin_footprints_have_finite_gradients_and_the_floor(settings, thin, gradients):
    """Hard: a needle or a disc on edge has no area at all; its opacity is lowered to the floor and no further."""
    splats, cameras = cloud(200, 33, 17)
    splats = replace(
        splats, scales=torch.where(torch.tensor([True, False, False]), splats.scales, thin * splats.scales)
    )
    splats = replace(splats, opacities=torch.full((200,), 0.99))
    image, grads = gradients(splats, replace(cameras, antialiased=True), settings)
    assert all(bool(x.isfinite().all()) for x in (image.color, image.alpha, image.depth, *grads.values()))
    assert 0.99 * constants.COMPENSATION_MIN > constants.ALPHA_MIN
    assert bool((image.alpha > 0).any())


@BOTH
def test_at_a_quarter_of_the_resolution_it_is_nearer_to_the_mean_of_pixels(settings):
    """Four times the ratio of one: what 4 × 4 pixels show together is what the one in their place shows."""
    splats, cameras = cloud(1500, 128, 96)
    splats = replace(splats, scales=0.15 * splats.scales, opacities=torch.full((1500,), 0.9))
    small = replace(cameras, focal_px=cameras.focal_px / 4, center_px=cameras.center_px / 4, width_px=32, height_px=24)
    fine = render(splats, replace(cameras, antialiased=True), CPU).color[0]
    truth = fine.reshape(24, 4, 32, 4, 3).mean((1, 3))
    errors = [
        float((render(splats, replace(small, antialiased=a), settings).color[0] - truth).square().mean())
        for a in (True, False)
    ]
    assert 10 * math.log10(errors[1] / errors[0]) > 2, errors
