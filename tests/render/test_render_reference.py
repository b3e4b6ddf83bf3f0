"""The CPU kernel against the float64 reference: values, gradients of attributes and of poses."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from genre_tasks.render import RenderSettings, render
from genre_tasks.scene.gaussians import Splats
from tests.scenes import pose_gradient_error, smooth

CPU, REFERENCE = RenderSettings("cpu", 1), RenderSettings("reference")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("width", "height"), [(64, 48), (33, 17), (1, 1)])
def test_values_and_gradients_of_300(scene, gradients, seed, width, height):
    splats, cameras = scene(300, width, height, views=2, seed=seed)
    image, grads = gradients(splats, cameras, CPU)
    truth, exact = gradients(splats, cameras, REFERENCE, torch.float64)
    for name, bound in (("color", 1e-5), ("alpha", 1e-5), ("depth", 3e-4)):
        error = getattr(image, name).double() - getattr(truth, name)
        assert error.abs().max() < bound, name
    for name, grad in grads.items():
        assert torch.linalg.vector_norm(exact[name]) > 0
        relative = torch.linalg.vector_norm(grad.double() - exact[name]) / torch.linalg.vector_norm(exact[name])
        assert relative <= 1e-5, (name, float(relative))


@pytest.mark.parametrize(("settings", "dtype", "bound"), [(CPU, torch.float32, 1e-5), (REFERENCE, torch.float64, 1e-7)])
def test_pose_gradient_against_finite_differences(settings, dtype, bound):
    assert pose_gradient_error(*smooth(), settings, dtype) < bound


def test_pose_gradient_leaves_the_image_and_other_gradients(scene, gradients):
    splats, cameras = scene(300, views=2)
    still, grads = gradients(splats, cameras, CPU)
    pose = cameras.camera_SE3_chunk.clone().requires_grad_()
    moving, other = gradients(splats, replace(cameras, camera_SE3_chunk=pose), CPU)
    assert pose.grad is not None and pose.grad[:, :3].abs().amax((1, 2)).min() > 0
    assert torch.allclose(still.color, moving.color, atol=2e-5)
    for name in grads:
        relative = torch.linalg.vector_norm(grads[name] - other[name]) / torch.linalg.vector_norm(grads[name])
        assert relative < 1e-4, (name, float(relative))
    assert moving.culled == still.culled


@pytest.mark.parametrize("settings", [CPU, REFERENCE], ids=["cpu", "reference"])
@pytest.mark.parametrize("attribute", ["means", "quats"])
def test_a_culled_gaussian_leaves_the_pose_gradient_finite(scene, settings, attribute):
    splats, cameras = scene(3)
    sound = replace(splats, opacities=splats.opacities * torch.tensor([1.0, 0.0, 1.0]))
    broken = getattr(splats, attribute).clone()
    broken[1, 0] = torch.nan
    gradients = []
    for given in (sound, replace(splats, **{attribute: broken})):
        pose = cameras.camera_SE3_chunk.clone().requires_grad_()
        image = render(given, replace(cameras, camera_SE3_chunk=pose), settings)
        image.color.sum().backward()
        gradients.append(pose.grad)
    assert image.culled == {"non_finite": 1} and gradients[0].abs().max() > 0
    torch.testing.assert_close(gradients[0], gradients[1])


@pytest.mark.parametrize("settings", [CPU, REFERENCE], ids=["cpu", "reference"])
def test_a_depth_that_overflows_poisons_no_neighbour(scene, settings):
    splats, cameras = scene(3)
    turn = torch.tensor([[0.5**0.5, 0, 0.5**0.5, 0], [0, 1, 0, 0], [-(0.5**0.5), 0, 0.5**0.5, 0], [0, 0, 0, 1]])
    means = splats.means @ turn[:3, :3]
    means[1] = 3e38 * (turn[:3, :3].T @ torch.tensor([0.0, 0.0, 1.0])) * 2**0.5
    given = replace(splats, means=means.requires_grad_())
    image = render(given, replace(cameras, camera_SE3_chunk=turn[None].to(cameras.camera_SE3_chunk)), settings)
    (image.color.sum() + image.depth.sum()).backward()
    assert torch.isfinite(image.depth).all() and torch.isfinite(means.grad).all()
    assert image.culled == {"degenerate": 1}


def test_reference_gradients_against_finite_differences():
    splats, cameras = smooth()
    inputs = [x.requires_grad_() for x in (splats.means, splats.scales, splats.quats, splats.opacities, splats.colors)]

    def images(*x: torch.Tensor) -> torch.Tensor:
        out = render(Splats(*x), cameras, REFERENCE)
        return torch.cat([out.color.flatten(), out.alpha.flatten(), out.depth.flatten()])[::37]

    assert torch.autograd.gradcheck(images, inputs, eps=1e-6, atol=1e-6)
