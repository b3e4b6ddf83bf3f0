"""PSNR after the colours of an image were fitted to its truth: the field's ``cc_psnr``.

What is left of the error is not one of exposure or white balance. The procedure is ``color_correct`` of multinerf, the
code of Mip-NeRF 360 (Barron et al. 2022) and RawNeRF, which gsplat's examples up to 1.5 use by that name, so that
numbers compare.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.logs.types import Float32, Float64
from genre_tasks.metrics.image_quality import psnr, widen_pair

ITERATIONS = 5
"""Fits one after the other: each changes which pixels are saturated."""

_SATURATED = 0.5 / 255
"""Colours nearer to 0 or 1 than this are cut off, and tell nothing of the light."""

_TERMS = 10
"""Terms of the polynomial: six products of two channels, three channels, and 1."""

_BLOCK = 8192
"""Pixels at once: their terms fit into the processor's cache, which takes a fifth of the time."""

# The published fit is in float32, whose directions below the rounding of the largest one count as absent. Here they are
# eigenvalues of a product of the design with itself, hence the square.
_RELATIVE_TOLERANCE = float(np.finfo(np.float32).eps) ** 2


def cc_psnr(
    image: Float32,  # [H, W, 3] sRGB in [0, 1]
    truth: Float32,  # [H, W, 3]
    mask: NDArray[np.bool_] | None = None,  # [H, W]
) -> float:
    """Computes PSNR after the image's colours were fitted to the truth's.

    Args:
        image: the image to judge.
        truth: what it should show.
        mask: pixels that count, for the fit and for the error; ``None``: all.

    Returns:
        dB, at most 100. It can be lower than PSNR, since saturated pixels have no part in the fit.

    Raises:
        ValueError: shapes differ, or the mask is empty.
        NonFiniteError: a value is NaN or infinite.

    >>> truth = np.random.default_rng(0).uniform(0.2, 0.8, (16, 16, 3)).astype(np.float32)
    >>> darker = truth * np.float32(0.7)
    >>> round(psnr(darker, truth)), cc_psnr(darker, truth) > 90
    (16, True)
    """
    return psnr(fit_colors(image, truth, mask), truth, mask)


def fit_colors(
    image: Float32,  # [H, W, 3] sRGB in [0, 1]
    truth: Float32,  # [H, W, 3]
    mask: NDArray[np.bool_] | None = None,  # [H, W]
) -> Float64:  # [H, W, 3]
    """Warps an image's colours to those of its truth, by one quadratic polynomial of the colour for each channel.

    The polynomial is the least-squares fit over pixels that are saturated neither in the image, in what the fits before
    made of it, nor in the truth. A channel without such a pixel keeps its colours; published code makes it black.

    Args:
        image: the image whose colours are fitted.
        truth: the colours that it should have.
        mask: pixels that the fit is made on; ``None``: all.

    Returns:
        The fitted image in [0, 1]; outside of the mask, the image as it is.

    Raises:
        ValueError: shapes differ, or the mask is empty.
        NonFiniteError: a value is NaN or infinite.
    """
    # In float64, where the product of the design with itself keeps the digits that the published fit has.
    image64, truth64 = widen_pair(image, truth, mask)
    selected = np.ones(image.shape[:2], np.bool_) if mask is None else mask
    # Channels first, so that sums over pixels read memory in order.
    colors = torch.from_numpy(image64[selected].T.copy())
    true_colors = torch.from_numpy(truth64[selected].T.copy())
    usable = _is_unsaturated(colors) & _is_unsaturated(true_colors)
    for _ in range(ITERATIONS):
        colors = _fit_once(colors, true_colors, usable & _is_unsaturated(colors))
    fitted = image64.copy()
    fitted[selected] = colors.T.numpy()
    return fitted


def _fit_once(colors: Tensor, true_colors: Tensor, usable: Tensor) -> Tensor:
    """Colours [3, N] after one fit to [3, N] on the usable ones [3, N]."""
    products = torch.zeros((3, _TERMS, _TERMS), dtype=colors.dtype)
    goals = torch.zeros((3, _TERMS), dtype=colors.dtype)
    # The normal equations, block by block.
    for block, goal, counts in zip(*(x.split(_BLOCK, 1) for x in (colors, true_colors, usable)), strict=True):
        terms = _quadratic_terms(block)
        for channel in range(3):
            counted = terms * counts[channel]
            products[channel] += counted @ terms.T
            goals[channel] += counted @ goal[channel]
    inverses = torch.linalg.pinv(products, rtol=_RELATIVE_TOLERANCE, hermitian=True)
    weights = (inverses @ goals[..., None])[..., 0]
    fitted = torch.cat([weights @ _quadratic_terms(block) for block in colors.split(_BLOCK, 1)], 1).clamp(0, 1)
    # Nothing to fit gives weights of 0, which would turn a white image with a white truth black.
    return torch.where(usable.any(1, keepdim=True), fitted, colors)


def _quadratic_terms(colors: Tensor) -> Tensor:
    """[10, N] terms of colours [3, N]."""
    products = [colors[c : c + 1] * colors[c:] for c in range(3)]
    return torch.cat([*products, colors, torch.ones_like(colors[:1])])


def _is_unsaturated(colors: Tensor) -> Tensor:
    return (colors >= _SATURATED) & (colors <= 1 - _SATURATED)
