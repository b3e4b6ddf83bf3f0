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

from genre_tasks.losses.constants import C1, C2, RADIUS, SIGMA


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
    x = images[None].permute(0, 3, 1, 2)  # with these strides torch sees channels last: ten times as fast
    vertical = taps.view(1, 1, -1, 1).expand(channels, 1, -1, 1).contiguous()
    x = F.conv2d(x, vertical, padding=(RADIUS, 0), groups=channels)
    x = F.conv2d(x, vertical.transpose(2, 3).contiguous(), padding=(0, RADIUS), groups=channels)
    return x[0].permute(1, 2, 0)


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor, mean_y: Tensor, variance_y: Tensor) -> Tensor:
        mean, square, product = blur(torch.cat([x, x * x, x * y], -1)).split(3, -1)
        mean_mean, mean_square = mean * mean_y, mean * mean
        luminance = (2 * mean_mean).add_(C1)
        structure = torch.sub(product, mean_mean).mul_(2).add_(C2)
        level = (mean_y * mean_y).add_(mean_square).add_(C1)
        spread = torch.sub(square, mean_square).add_(variance_y).add_(C2)
        denominator = level * spread
        value = (luminance * structure).div_(denominator)
        if ctx.needs_input_grad[0]:
            maps = torch.empty((*value.shape[:2], 9), dtype=value.dtype, device=value.device)
            by_mean, by_variance, by_covariance = maps.split(3, -1)
            torch.div(luminance.mul_(2), denominator, out=by_covariance)
            torch.div(value, spread, out=by_variance).neg_()
            torch.mul(mean_y, structure.mul_(2).div_(denominator), out=by_mean)
            by_mean.sub_(2 * mean * (value / level + by_variance)).addcmul_(mean_y, by_covariance, value=-1)
            a, b, c = blur(maps).split(3, -1)
            ctx.save_for_backward((b * x).mul_(2).add_(a).addcmul_(y, c).div_(value.numel()))
        return value.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return grad * gradient, None, None, None
