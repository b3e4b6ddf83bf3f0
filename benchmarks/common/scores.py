"""PSNR of views, for benchmarks that render without the evaluation stage."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_LEAST_SQUARED_ERROR = 1e-10
"""Keeps identical images at 100 dB, as an infinite one would spoil every mean."""


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
    return -10 * torch.log10((images - truth).square().mean((1, 2, 3)).clamp_min(_LEAST_SQUARED_ERROR))


def pooled_psnr(squared_error: float, pixels: int) -> float:
    """Computes the PSNR of the pixels of several images together.

    Args:
        squared_error: sum over the pixels of the mean square over their channels; of sRGB in [0, 1].
        pixels: how many, at least one.

    Returns:
        dB, at most 100.

    >>> pooled_psnr(1.0, 100), pooled_psnr(0.0, 100)
    (20.0, 100.0)
    """
    return -10 * math.log10(max(squared_error / pixels, _LEAST_SQUARED_ERROR))
