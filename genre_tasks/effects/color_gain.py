"""Gains of images: what exposure and white balance make of the scene's own colours, and back.

An image is the scene's own colours times a gain in linear light, one for each channel. In sRGB's own numbers, above its
toe, that is an affine map: ((c + 0.055) g^(1/2.4)) − 0.055.
"""

from __future__ import annotations

import torch
from torch import Tensor

_TOE = 0.055
_POWER = 2.4
MAX_LOG_GAIN = 4.0
"""Logarithm of the largest gain that is applied, and minus that of the smallest: a factor of 55."""


def apply_gain(color: Tensor, log_gain: Tensor) -> Tensor:
    """Shows the scene's colours as an image with a gain would. Differentiable in both arguments.

    Args:
        color: [..., 3] sRGB of the scene.
        log_gain: [..., 3] natural logarithm of the gain in linear light; ``MAX_LOG_GAIN`` bounds it.

    Returns:
        [..., 3] sRGB, not clamped.

    >>> color = torch.full((3,), 0.5)
    >>> brighter = apply_gain(color, torch.tensor([0.0, 0.5, 1.0]))
    >>> (brighter[1:] > brighter[:-1]).all().item()
    True
    """
    return (color + _TOE) * gain_factor(log_gain) - _TOE


def gain_factor(log_gain: Tensor) -> Tensor:
    """Computes the derivative of :func:`apply_gain` by the scene's colour.

    Args:
        log_gain: [..., 3] natural logarithm of the gain in linear light.

    Returns:
        [..., 3] factor on sRGB values above the toe.
    """
    # Bounded, because a gain that was estimated from a black image could otherwise make colours infinite.
    return torch.exp(log_gain.clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN) / _POWER)


def remove_gain(image: Tensor, log_gain: Tensor) -> Tensor:
    """Recovers the scene's own colours from an image with a gain; the inverse of :func:`apply_gain`.

    Args:
        image: [..., 3] sRGB in [0, 1].
        log_gain: [..., 3] the image's gain.

    Returns:
        [..., 3] in [0, 1]; clipped channels stay clipped.

    >>> gain = torch.tensor([0.3, 0.0, -0.3])
    >>> color = torch.full((3,), 0.5)
    >>> torch.allclose(remove_gain(apply_gain(color, gain), gain), color)
    True
    """
    color = (image + _TOE) / gain_factor(log_gain) - _TOE
    # A clipped channel was at least this bright: a smaller value would teach the scene a tint that no camera saw.
    return torch.where(image >= 1, torch.maximum(color, image), color).clamp(0, 1)
