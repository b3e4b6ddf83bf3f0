"""SSIM against a fixed target, fast enough to be computed for every view in every iteration.

The target's local mean and variance are computed once. The gradient is written out by hand: three convolutions
forwards and three backwards, each a separable Gaussian of 11 taps (σ 1.5, Wang et al. 2004). Outside of the image
everything counts as black.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from genre_tasks.losses.constants import C1, C2, RADIUS, SIGMA

KEPT_PIXELS = 300_000
"""Statistics of larger images are computed at every comparison: kept, they take twice the memory of the images."""


@dataclass(frozen=True)
class SsimTarget:
    """An image with the local statistics that SSIM needs of it.

    Attributes:
        pixels: [H, W, 3] the image in [0, 1].
        mean: [H, W, 3] its mean in the Gaussian window around each pixel; ``None``: not computed yet.
        variance: [H, W, 3] its variance in that window; ``None``: not computed yet.
    """

    pixels: Tensor
    mean: Tensor | None = None
    variance: Tensor | None = None

    @staticmethod
    def of_many(image: Tensor) -> SsimTarget:
        """Makes a target that is one of many: statistics of a large image would take too much memory.

        Args:
            image: [H, W, 3] in [0, 1].

        Returns:
            The image, with its statistics where it has at most ``KEPT_PIXELS``.

        >>> SsimTarget.of_many(torch.zeros(720, 1280, 3)).mean is None
        True
        """
        height, width, _ = image.shape
        return SsimTarget.from_image(image) if height * width <= KEPT_PIXELS else SsimTarget(image)

    def get_statistics(self) -> tuple[Tensor, Tensor]:
        """Gives mean and variance, computed where they were not.

        Returns:
            [H, W, 3] each.
        """
        if self.mean is None or self.variance is None:
            computed = SsimTarget.from_image(self.pixels)
            assert computed.mean is not None and computed.variance is not None
            return computed.mean, computed.variance
        return self.mean, self.variance

    @staticmethod
    def from_image(image: Tensor) -> SsimTarget:
        """Computes the statistics of an image.

        Args:
            image: [H, W, 3] in [0, 1].

        Returns:
            The image itself, not a copy, with its local mean and variance.

        >>> target = SsimTarget.from_image(torch.full((16, 16, 3), 0.5))
        >>> bool(target.variance[8, 8].abs().max() < 1e-6)
        True
        """
        # One blur of six channels instead of two of three: fewer calls for the same sums.
        mean, mean_of_square = blur(torch.cat([image, image * image], -1)).split(3, -1)
        return SsimTarget(image, mean.contiguous(), (mean_of_square - mean * mean).contiguous())


def ssim(image: Tensor, target: SsimTarget) -> Tensor:
    """Computes the mean structural similarity of an image with a target (Wang et al. 2004).

    Args:
        image: [H, W, 3] in [0, 1]; the result can be differentiated with respect to it, once.
        target: the image to compare with, of the same shape.

    Returns:
        A scalar in [−1, 1], 1 for equal images.

    Raises:
        ValueError: the shapes differ.

    >>> image = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
    >>> bool((ssim(image, SsimTarget.from_image(image)) - 1).abs() < 1e-5)
    True
    """
    if image.shape != target.pixels.shape:
        raise ValueError(f"expected an image of shape {tuple(target.pixels.shape)}, got {tuple(image.shape)}")
    return _Ssim.apply(image, target.pixels, *target.get_statistics())


def blur(images: Tensor) -> Tensor:
    """Convolves images with SSIM's Gaussian window along both axes.

    Args:
        images: [H, W, C].

    Returns:
        [H, W, C], with zeros taken outside of the images.
    """
    channels = images.shape[-1]
    taps = torch.exp(-((torch.arange(2 * RADIUS + 1, dtype=images.dtype) - RADIUS) ** 2) / (2 * SIGMA**2))
    taps = (taps / taps.sum()).to(images.device)
    # With these strides torch takes its channels-last convolution, which is ten times as fast here.
    x = images[None].permute(0, 3, 1, 2)
    vertical = taps.view(1, 1, -1, 1).expand(channels, 1, -1, 1).contiguous()
    x = F.conv2d(x, vertical, padding=(RADIUS, 0), groups=channels)
    x = F.conv2d(x, vertical.transpose(2, 3).contiguous(), padding=(0, RADIUS), groups=channels)
    return x[0].permute(1, 2, 0)


class _Ssim(torch.autograd.Function):
    """Mean SSIM of ``x`` with ``y``, whose statistics are known; differentiable in ``x`` alone."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor, mean_y: Tensor, variance_y: Tensor) -> Tensor:
        mean, mean_of_square, mean_of_product = blur(torch.cat([x, x * x, x * y], -1)).split(3, -1)
        product_of_means = mean * mean_y
        square_of_mean = mean * mean
        # Wang's two factors: (2 μx μy + C1) (2 σxy + C2) over (μx² + μy² + C1) (σx² + σy² + C2).
        luminance = (2 * product_of_means).add_(C1)
        structure = torch.sub(mean_of_product, product_of_means).mul_(2).add_(C2)
        level = (mean_y * mean_y).add_(square_of_mean).add_(C1)
        spread = torch.sub(mean_of_square, square_of_mean).add_(variance_y).add_(C2)
        denominator = level * spread
        value = (luminance * structure).div_(denominator)
        if ctx.needs_input_grad[0]:
            # The derivative by x comes from those by the blurred x, x² and x·y. Blurring is its own adjoint, so one
            # blur of the three maps brings them back to pixels. It is done here because all factors are at hand.
            maps = torch.empty((*value.shape[:2], 9), dtype=value.dtype, device=value.device)
            by_mean, by_variance, by_covariance = maps.split(3, -1)
            torch.div(luminance.mul_(2), denominator, out=by_covariance)
            torch.div(value, spread, out=by_variance).neg_()
            torch.mul(mean_y, structure.mul_(2).div_(denominator), out=by_mean)
            by_mean.sub_(2 * mean * (value / level + by_variance)).addcmul_(mean_y, by_covariance, value=-1)
            from_mean, from_square, from_product = blur(maps).split(3, -1)
            gradient = (from_square * x).mul_(2).add_(from_mean).addcmul_(y, from_product).div_(value.numel())
            ctx.save_for_backward(gradient)
        return value.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return grad * gradient, None, None, None
