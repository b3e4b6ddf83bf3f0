"""The one border between display-referred sRGB (the pipeline) and scene-linear light (EXR).

A linear value kept as half has a relative error of at most 2⁻¹¹, which the sRGB curve flattens to 0.44 times that.
The way there and back is within :data:`ROUNDING_BOUND` in display space for colours in [0, 1] (measured: 2.3e-4),
premultiplied or not. The same relative bound holds above 1, where the curve is extended.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import NonFiniteError
from genre_tasks.srgb import linear_to_srgb, srgb_to_linear

__all__ = ["HALF_MAX", "ROUNDING_BOUND", "from_linear_half", "linear_to_srgb", "srgb_to_linear", "to_linear_half"]

ROUNDING_BOUND = 1e-3
"""Largest difference in display space, for colours in [0, 1], after the way to EXR and back."""

HALF_MAX = 65504.0
"""The largest number in half precision."""


def to_linear_half(
    color: NDArray[np.float32],  # [H, W, 3] display-referred, premultiplied
    alpha: NDArray[np.float32] | None,  # [H, W]
    name: str,
) -> NDArray[np.float16]:  # [H, W, 3] scene-linear, premultiplied
    """Converts an image for EXR: un-premultiplies, linearises, premultiplies.

    Args:
        color: [H, W, 3] display-referred, premultiplied.
        alpha: [H, W] in [0, 1]; ``None`` for an opaque image.
        name: what an error calls the image.

    Returns:
        [H, W, 3] scene-linear, premultiplied; 0 where alpha is 0.

    Raises:
        NonFiniteError: a colour is NaN or infinite, or brighter than :data:`HALF_MAX`.
    """
    if alpha is None:
        light = srgb_to_linear(color)
    else:
        # The curve is not linear: applied to premultiplied colour it would darken edges.
        cover = alpha.astype(np.float64)[..., None]
        light = srgb_to_linear(np.divide(color, cover, out=np.zeros(color.shape), where=cover > 0)) * cover
    # Light that half cannot hold is an error and not clamped: that would change the image silently.
    bad = ~(np.abs(light) <= HALF_MAX)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise NonFiniteError("storage", f"{name} (scene-linear, as half)", int(bad.sum()), first)
    return light.astype(np.float16)


def from_linear_half(light: NDArray[np.float16], alpha: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """Converts an image from EXR: the inverse of :func:`to_linear_half`.

    Args:
        light: [H, W, 3] scene-linear, premultiplied.
        alpha: [H, W] in [0, 1]; ``None`` for an opaque image.

    Returns:
        [H, W, 3] display-referred, premultiplied, float32; 0 where alpha is 0.

    >>> from_linear_half(np.full((1, 1, 3), 1.0, np.float16), None)
    array([[[1., 1., 1.]]], dtype=float32)
    """
    if alpha is None:
        return linear_to_srgb(light).astype(np.float32)
    cover = alpha.astype(np.float64)[..., None]
    bare = np.divide(light, cover, out=np.zeros(light.shape), where=cover > 0)
    return (linear_to_srgb(bare) * cover).astype(np.float32)
