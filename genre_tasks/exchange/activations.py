"""Values of files as 3DGS optimises them, and back: opacities as logits, scales as logarithms, colours as harmonics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.exchange.types import SH_DC
from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.gaussians import OPACITY_CLAMP


def opacities_to_logits(opacities: Float64) -> Float32:
    """Takes opacities to logits; those of 0 and 1 to the logits of 1e-6 and 1 − 1e-6, so that they are finite.

    Args:
        opacities: of any shape, in [0, 1].

    >>> [round(x, 1) for x in opacities_to_logits(np.array([0.0, 0.5])).tolist()]
    [-13.8, 0.0]
    """
    bounded = np.clip(np.asarray(opacities, np.float64), OPACITY_CLAMP, 1 - OPACITY_CLAMP)
    return np.asarray(np.log(bounded) - np.log1p(-bounded), np.float32)


def logits_to_opacities(logits: Float32) -> Float64:
    """Takes logits to opacities, without overflow.

    Args:
        logits: of any shape.

    >>> logits_to_opacities(np.array([-1000.0, 0.0], np.float32)).tolist()
    [0.0, 0.5]
    """
    wide = np.asarray(logits, np.float64)
    small = np.exp(-np.abs(wide))
    return np.asarray(np.where(wide < 0, small, 1.0) / (1.0 + small))


def colors_to_sh_dc(colors: Float64) -> Float32:
    """Takes colours to coefficients of the constant harmonic.

    Args:
        colors: [..., 3] sRGB, nominally in [0, 1].
    """
    return np.asarray((np.asarray(colors, np.float64) - 0.5) / SH_DC, np.float32)


def sh_dc_to_colors(sh_dc: Float32) -> Float64:
    """Takes coefficients of the constant harmonic to colours.

    Args:
        sh_dc: [..., 3].

    >>> sh_dc_to_colors(np.zeros(3, np.float32)).tolist()
    [0.5, 0.5, 0.5]
    """
    return 0.5 + SH_DC * np.asarray(sh_dc, np.float64)


def scales_to_logs(path: Path, scales: Float32) -> Float32:
    """Takes linear scales of a file to logarithms.

    Args:
        path: of the file, for the error.
        scales: [N, 3] metres.

    Raises:
        InputError: a scale is not above 0, with the number of such Gaussians and the first of them.
    """
    # Written so that NaN is found too.
    bad = np.flatnonzero(~(scales > 0).all(1))
    if len(bad):
        problem = f"the scales of {len(bad)} Gaussians are not above 0, the first is number {bad[0]} from 0 on"
        raise InputError(problem, remedy="Export the file again without flat Gaussians.", file=path)
    return np.asarray(np.log(scales.astype(np.float64)), np.float32)


def logs_to_scales(path: Path, log_scales: Float32) -> Float32:
    """Takes logarithms of scales to linear ones.

    Args:
        path: of the file that they are written to, for the error.
        log_scales: [N, 3] natural logarithms of metres.

    Raises:
        InputError: a scale is too large or too small for float32.
    """
    scales = np.exp(log_scales.astype(np.float64))
    limits = np.finfo(np.float32)
    bad = np.flatnonzero(~((scales >= limits.tiny) & (scales <= limits.max)).all(1))
    if len(bad):
        problem = f"the scales of {len(bad)} Gaussians do not fit into float32, the first is number {bad[0]} from 0 on"
        raise InputError(problem, remedy="Write a PLY file, which holds logarithms of scales.", file=path)
    return np.asarray(scales, np.float32)
