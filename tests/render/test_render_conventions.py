"""What the numbers of an image mean; hard cases of the input are in ``tests/hard_cases/``."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from genre_tasks.errors import NonFiniteError
from genre_tasks.render import Cameras, RenderSettings, render
from genre_tasks.render.types import VisibleRanges
from genre_tasks.scene.gaussians import Splats

BOTH = pytest.mark.parametrize(
    "settings", [RenderSettings("cpu", 1), RenderSettings("reference")], ids=lambda s: s.backend
)


def _camera(size: int = 17, focal: float = 50.0) -> Cameras:
    return Cameras(torch.eye(4)[None], torch.full((1, 2), focal), torch.full((1, 2), size / 2), size, size)


def _on_axis(depths: list[float], opacities: list[float]) -> Splats:
    n = len(depths)
    means = torch.zeros(n, 3)
    means[:, 2] = torch.tensor(depths)
    colors = torch.tensor([[0.2, 0.5, 0.8]]).repeat(n, 1)
    return Splats(
        means, torch.full((n, 3), 0.2), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.tensor(opacities), colors
    )


@BOTH
def test_one_gaussian_is_the_analytic_one(settings):
    out = render(_on_axis([5.0], [0.8]), _camera(), settings)
    offset = torch.arange(17.0) - 8  # pixel centres from the principal point
    variance = (50 * 0.2 / 5) ** 2 + 0.3
    alpha = 0.8 * torch.exp(-(offset[:, None] ** 2 + offset[None] ** 2) / (2 * variance))
    alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros(()))
    assert 0 < (alpha > 0).float().mean() < 1
    assert torch.allclose(out.alpha[0], alpha, atol=1e-6)
    assert torch.allclose(out.depth[0], 5 * alpha, atol=5e-6)
    assert torch.allclose(out.color[0], alpha[..., None] * torch.tensor([0.2, 0.5, 0.8]), atol=1e-6)
    assert torch.allclose(out.expected_depth()[0], torch.where(alpha > 0, 5.0, 0.0), atol=1e-4)


@BOTH
def test_alpha_clamps_without_gradient_and_two_opaque_layers_end_a_ray(settings):
    splats = _on_axis([5.0, 6.0, 7.0], [1.0, 1.0, 1.0])
    opacities = splats.opacities.clone().requires_grad_()
    out = render(replace(splats, opacities=opacities), _camera(), settings)
    middle = (0, 8, 8)
    assert out.alpha[middle].item() == pytest.approx(1 - 0.01**2, abs=1e-6)  # the third layer is not reached
    assert out.depth[middle].item() == pytest.approx(0.99 * 5 + 0.01 * 0.99 * 6, abs=1e-5)
    out.alpha[middle].backward()
    assert opacities.grad is not None and torch.equal(opacities.grad, torch.zeros(3))


@BOTH
def test_opacity_gradient_below_the_clamp(settings):
    opacities = torch.tensor([0.6], requires_grad=True)
    out = render(replace(_on_axis([5.0], [0.6]), opacities=opacities), _camera(), settings)
    out.alpha[0, 8, 8].backward()
    assert opacities.grad is not None and opacities.grad.item() == pytest.approx(1.0, abs=1e-6)


@BOTH
def test_nothing_to_draw(scene, settings):
    splats, cameras = scene(0, 33, 17, views=2)
    out = render(splats, cameras, settings)
    assert out.color.shape == (2, 17, 33, 3) and out.alpha.shape == out.depth.shape == (2, 17, 33)
    assert not out.color.any() and not out.alpha.any() and not out.depth.any() and out.culled == {}
    splats, cameras = scene(50)
    none = replace(cameras, **{n: getattr(cameras, n)[:0] for n in ("camera_SE3_chunk", "focal_px", "center_px")})
    assert render(splats, none, settings).color.shape == (0, 48, 64, 3)
    by_view = replace(splats, colors=torch.zeros(0, 50, 3))
    assert render(by_view, none, settings).color.shape == (0, 48, 64, 3)
    some = VisibleRanges(30, ())
    assert render(splats, none, settings, some).color.shape == (0, 48, 64, 3)


@BOTH
def test_bad_quaternions_and_what_is_behind_are_counted(scene, gradients, settings):
    splats, cameras = scene(40, views=2)
    quats, means = splats.quats.clone(), splats.means.clone()
    quats[3], quats[4] = 0.0, 1e-4
    means[5] = torch.tensor([0.0, 0.0, -3.0])
    out, grads = gradients(replace(splats, quats=quats, means=means), cameras, settings)
    assert out.culled == {"quaternion": 4, "behind": 2}
    assert all(torch.isfinite(g).all() and not g[3:6].any() for g in grads.values())


def test_faulty_arguments_are_named(scene):
    splats, cameras = scene(5)
    with pytest.raises(ValueError, match=r"expected quats of shape \(5, 4\), got \(5, 3\)"):
        render(replace(splats, quats=splats.quats[:, :3]), cameras)
    bad = cameras.camera_SE3_chunk.clone()
    bad[0, 1, 3] = math.nan
    with pytest.raises(NonFiniteError) as caught:
        render(splats, replace(cameras, camera_SE3_chunk=bad))
    assert caught.value.tensor == "camera_SE3_chunk" and caught.value.first_index == (0, 1, 3)


def test_no_views_of_poses_that_want_a_gradient():
    poses = torch.zeros(0, 4, 4, requires_grad=True)
    cameras = Cameras(poses, torch.zeros(0, 2), torch.zeros(0, 2), 8, 6)
    for backend in ("cpu", "reference"):
        assert render(_on_axis([2.0], [0.5]), cameras, RenderSettings(backend)).color.shape == (0, 6, 8, 3)
