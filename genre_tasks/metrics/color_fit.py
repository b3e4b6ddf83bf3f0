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
    colors = torch.from_numpy(image64[selected])
    true_colors = torch.from_numpy(truth64[selected])
    usable = _is_unsaturated(colors) & _is_unsaturated(true_colors)
    for _ in range(ITERATIONS):
        colors = _fit_once(colors, true_colors, usable & _is_unsaturated(colors))
    fitted = image64.copy()
    fitted[selected] = colors.numpy()
    return fitted


def _fit_once(colors: Tensor, true_colors: Tensor, usable: Tensor) -> Tensor:
    """Colours [N, 3] after one fit to [N, 3] on the usable ones [N, 3]."""
    design = _quadratic_terms(colors)
    channels = []
    for channel in range(3):
        rows = design[usable[:, channel]]
        # Nothing to fit: weights of 0 would turn a white image with a white truth black.
        if not len(rows):
            channels.append(colors[:, channel])
            continue
        # The normal equations: ten unknowns, and a pixel is read once.
        inverse = torch.linalg.pinv(rows.T @ rows, rtol=_RELATIVE_TOLERANCE, hermitian=True)
        weights = inverse @ (rows.T @ true_colors[usable[:, channel], channel])
        channels.append((design @ weights).clamp(0, 1))
    return torch.stack(channels, 1)


def _quadratic_terms(colors: Tensor) -> Tensor:
    """[N, 10] products of two channels, channels, and 1."""
    products = [colors[:, c : c + 1] * colors[:, c:] for c in range(3)]
    return torch.cat([*products, colors, torch.ones_like(colors[:, :1])], 1)


def _is_unsaturated(colors: Tensor) -> Tensor:
    return (colors >= _SATURATED) & (colors <= 1 - _SATURATED)
