"""SSIM against a fixed target, fast enough to be taken in every view of every iteration.

The target's local mean and variance are computed once. The gradient is written out: three convolutions forwards and
three backwards, each a separable 11-tap Gaussian (σ 1.5, Wang et al. 2004), with images taken as black outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

RADIUS, SIGMA = 5, 1.5
C1, C2 = 0.01**2, 0.03**2
"""Wang's constants for images in [0, 1]: they keep constant and black images finite."""


@dataclass(frozen=True)
class SsimTarget:
    """An image with what SSIM needs of it, each [H, W, 3] float32."""

    image: Tensor
    mean: Tensor
    variance: Tensor

    @staticmethod
    def of(image: Tensor) -> SsimTarget:
        """From an image [H, W, 3] in [0, 1]."""
        mean, square = blur(torch.cat([image, image * image], -1)).split(3, -1)
        return SsimTarget(image, mean.contiguous(), (square - mean * mean).contiguous())


def ssim(image: Tensor, target: SsimTarget) -> Tensor:
    """Mean SSIM of ``image`` [H, W, 3] with the target, a scalar in [−1, 1], differentiable in ``image`` (once)."""
    if image.shape != target.image.shape:
        raise ValueError(f"expected an image of shape {tuple(target.image.shape)}, got {tuple(image.shape)}")
    return _Ssim.apply(image, target.image, target.mean, target.variance)


def blur(images: Tensor) -> Tensor:
    """[H, W, C] convolved with the Gaussian window along both axes, same size, zeros outside."""
    channels = images.shape[-1]
    taps = torch.exp(-((torch.arange(2 * RADIUS + 1, dtype=images.dtype) - RADIUS) ** 2) / (2 * SIGMA**2))
    taps = (taps / taps.sum()).to(images.device)
    x = images.permute(2, 0, 1)[None]  # channels last in memory: four times as fast as planes
    x = F.conv2d(x, taps.view(1, 1, -1, 1).expand(channels, 1, -1, 1), padding=(RADIUS, 0), groups=channels)
    x = F.conv2d(x, taps.view(1, 1, 1, -1).expand(channels, 1, 1, -1), padding=(0, RADIUS), groups=channels)
    return x[0].permute(1, 2, 0)


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor, mean_y: Tensor, variance_y: Tensor) -> Tensor:
        mean, square, product = blur(torch.cat([x, x * x, x * y], -1)).split(3, -1)
        luminance = 2 * mean * mean_y + C1
        structure = 2 * (product - mean * mean_y) + C2
        level = mean * mean + mean_y * mean_y + C1
        spread = square - mean * mean + variance_y + C2
        value = luminance * structure / (level * spread)
        if ctx.needs_input_grad[0]:
            by_covariance = 2 * luminance / (level * spread)
            by_variance = -value / spread
            by_mean = 2 * mean_y * structure / (level * spread) - 2 * mean * value / level
            by_mean = by_mean - 2 * mean * by_variance - mean_y * by_covariance
            a, b, c = blur(torch.cat([by_mean, by_variance, by_covariance], -1)).split(3, -1)
            ctx.save_for_backward((a + 2 * x * b + y * c) / value.numel())
        return value.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return grad * gradient, None, None, None
