"""PSNR of views, for benchmarks that render without the evaluation stage."""

from __future__ import annotations

import torch
from torch import Tensor


def psnr_per_view(images: Tensor, truth: Tensor) -> Tensor:
    """Computes the PSNR of each of many images at once, in float32.

    Args:
        images: [V, H, W, 3] sRGB in [0, 1].
        truth: [V, H, W, 3].

    Returns:
        [V] dB, at most 100.

    >>> psnr_per_view(torch.full((1, 2, 2, 3), 0.6), torch.full((1, 2, 2, 3), 0.5)).round().tolist()
    [20.0]
    """
    # The floor keeps identical images at 100 dB, as an infinite one would spoil every mean.
    return -10 * torch.log10((images - truth).square().mean((1, 2, 3)).clamp_min(1e-10))
