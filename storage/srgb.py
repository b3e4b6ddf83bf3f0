"""The one border between display-referred sRGB (the pipeline) and scene-linear light (EXR).

Rounding: a linear value kept as half has a relative error of at most 2⁻¹¹, which the sRGB curve flattens to 0.44 times
that; for values in [0, 1] the way there and back is within :data:`ROUNDING_BOUND` in display space (measured:
2.3e-4), premultiplied or not. Values outside [0, 1] follow the curve extended and mirrored at 0, with the same relative
bound above 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import NonFiniteError

ROUNDING_BOUND = 1e-3
"""Largest difference in display space, for colours in [0, 1], after the way to EXR and back."""

HALF_MAX = 65504.0


def srgb_to_linear(display: NDArray[Any]) -> NDArray[np.float64]:
    """IEC 61966-2-1, mirrored for negative values; any shape, float64."""
    x = np.asarray(display, np.float64)
    size = np.abs(x)
    return np.copysign(np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4), x)


def linear_to_srgb(linear: NDArray[Any]) -> NDArray[np.float64]:
    """The inverse of :func:`srgb_to_linear`."""
    x = np.asarray(linear, np.float64)
    size = np.abs(x)
    return np.copysign(np.where(size <= 0.0031308, size * 12.92, 1.055 * size ** (1 / 2.4) - 0.055), x)


def to_linear_half(
    color: NDArray[np.float32],  # [H, W, 3] display-referred, premultiplied
    alpha: NDArray[np.float32] | None,  # [H, W] in [0, 1], or None: opaque
    name: str,
) -> NDArray[np.float16]:  # [H, W, 3] scene-linear, premultiplied
    """To EXR: un-premultiply, linearise, premultiply. Colour where alpha = 0 is 0.

    Raises ``NonFiniteError`` naming ``name`` for non-finite input and for light above 65504, the largest half: it is
    not clamped, since that would change the image silently.
    """
    if alpha is None:
        light = srgb_to_linear(color)
    else:
        cover = alpha.astype(np.float64)[..., None]
        light = srgb_to_linear(np.divide(color, cover, out=np.zeros(color.shape), where=cover > 0)) * cover
    bad = ~(np.abs(light) <= HALF_MAX)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise NonFiniteError("storage", f"{name} (scene-linear, as half)", int(bad.sum()), first)
    return light.astype(np.float16)


def from_linear_half(light: NDArray[np.float16], alpha: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """From EXR: the inverse of :func:`to_linear_half`; [H, W, 3] float32, 0 where alpha = 0."""
    if alpha is None:
        return linear_to_srgb(light).astype(np.float32)
    cover = alpha.astype(np.float64)[..., None]
    bare = np.divide(light, cover, out=np.zeros(light.shape), where=cover > 0)
    return (linear_to_srgb(bare) * cover).astype(np.float32)
