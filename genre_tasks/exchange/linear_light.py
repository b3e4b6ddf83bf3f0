"""Harmonics of files whose colours are linear light, as the sRGB that Gaussians have."""

from __future__ import annotations

import numpy as np

from genre_tasks.exchange.activations import colors_to_sh_dc, sh_dc_to_colors
from genre_tasks.logs.types import Float32, Float64
from genre_tasks.srgb import linear_to_srgb

LINEAR_LOSS = "The file's colours are linear light: their tint by direction is converted to sRGB to first order only."
"""What is lost of such a file."""

_SLOPE_STEP = 1e-4


def linear_harmonics_to_srgb(sh_dc: Float32, sh_rest: Float32) -> tuple[Float32, Float32]:
    """Takes harmonics of linear light to those of sRGB.

    Args:
        sh_dc: [N, 3] coefficients of the constant harmonic.
        sh_rest: [N, K, 3] further ones.

    Returns:
        Constant terms by sRGB's curve, and all others by its slope there.

    >>> sh_dc, _ = linear_harmonics_to_srgb(colors_to_sh_dc(np.full((1, 3), 0.214041)), np.zeros((1, 0, 3), np.float32))
    >>> sh_dc_to_colors(sh_dc).round(4).tolist()
    [[0.5, 0.5, 0.5]]
    """
    light = sh_dc_to_colors(sh_dc)
    slope: Float64 = (linear_to_srgb(light + _SLOPE_STEP) - linear_to_srgb(light - _SLOPE_STEP)) / (2 * _SLOPE_STEP)
    return colors_to_sh_dc(linear_to_srgb(light)), (sh_rest * slope[:, None]).astype(np.float32)
