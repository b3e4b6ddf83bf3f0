"""The transfer function of sRGB (IEC 61966-2-1): between display-referred colour and linear light."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

LUMA_WEIGHTS = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in brightness, ITU-R BT.601, by which JPEG files are made grey, too."""


def srgb_to_linear(display: ArrayLike) -> NDArray[np.float64]:
    """Converts display-referred sRGB into linear light.

    The curve is extended above 1 and mirrored at 0, so that it has an inverse everywhere.

    Args:
        display: colour of any shape, nominally in [0, 1].

    Returns:
        Linear light of the same shape, float64.

    >>> srgb_to_linear([0.0, 0.5, 1.0]).round(6)
    array([0.      , 0.214041, 1.      ])
    """
    x: NDArray[Any] = np.asarray(display, np.float64)
    size = np.abs(x)
    # Both branches are computed for all values: the power is defined for them, since the size is not negative.
    return np.copysign(np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4), x)


def linear_to_srgb(linear: ArrayLike) -> NDArray[np.float64]:
    """Converts linear light into display-referred sRGB: the inverse of :func:`srgb_to_linear`.

    Args:
        linear: linear light of any shape, nominally in [0, 1].

    Returns:
        Display-referred colour of the same shape, float64.

    >>> linear_to_srgb([0.0, 0.214041, 1.0]).round(4)
    array([0. , 0.5, 1. ])
    """
    x: NDArray[Any] = np.asarray(linear, np.float64)
    size = np.abs(x)
    return np.copysign(np.where(size <= 0.0031308, size * 12.92, 1.055 * size ** (1 / 2.4) - 0.055), x)
