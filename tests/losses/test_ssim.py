"""SSIM with a written-out gradient."""

from __future__ import annotations

import pytest
import torch

from genre_tasks.losses.ssim import SsimTarget, blur, ssim


def _images(height: int = 20, width: int = 31) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    return a, (a + 0.2 * torch.rand(height, width, 3, generator=generator, dtype=torch.float64)).clamp(0, 1)


def test_agrees_with_scikit_image_inside() -> None:
    from skimage.metrics import structural_similarity

    a, b = _images(60, 80)
    # Far from the border, where the two treat the outside differently: black frames of ten pixels.
    for image in (a, b):
        image[:10], image[-10:], image[:, :10], image[:, -10:] = 0, 0, 0, 0
    _, full = structural_similarity(
        a.numpy(),
        b.numpy(),
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    assert float(ssim(a, SsimTarget.from_image(b))) == pytest.approx(float(full.mean()), abs=2e-4)


def test_gradient_is_the_derivative() -> None:
    a, b = _images(12, 13)
    target = SsimTarget.from_image(b)
    assert torch.autograd.gradcheck(lambda x: ssim(x, target), (a.clone().requires_grad_(),), atol=1e-6)


def test_identical_images_score_one_with_no_gradient() -> None:
    a, _ = _images()
    x = a.clone().requires_grad_()
    value = ssim(x, SsimTarget.from_image(a))
    value.backward()
    assert float(value.detach()) == pytest.approx(1.0, abs=1e-12)
    assert float(x.grad.abs().max()) < 1e-10


@pytest.mark.parametrize("left", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("right", [0.0, 0.5, 1.0])
def test_constant_images_are_finite(left: float, right: float) -> None:
    x = torch.full((9, 7, 3), left, requires_grad=True)
    value = ssim(x, SsimTarget.from_image(torch.full((9, 7, 3), right)))
    value.backward()
    assert bool(torch.isfinite(value)) and bool(torch.isfinite(x.grad).all())
    assert -1.0 <= float(value.detach()) <= 1.0 + 1e-6


def test_one_pixel() -> None:
    assert bool(torch.isfinite(ssim(torch.rand(1, 1, 3), SsimTarget.from_image(torch.rand(1, 1, 3)))))


def test_blur_keeps_a_constant_inside_and_dims_the_border() -> None:
    out = blur(torch.ones(21, 21, 2))
    assert float(out[10, 10, 0]) == pytest.approx(1.0, abs=1e-6)
    assert float(out[0, 0, 0]) < 0.5


def test_other_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="expected an image of shape"):
        ssim(torch.rand(4, 4, 3), SsimTarget.from_image(torch.rand(4, 5, 3)))
