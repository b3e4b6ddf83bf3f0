"""Exposure and white balance: the same point is brighter in one image than in another.

An image is the scene's own colours times a gain in linear light, one for each channel. In sRGB's own numbers, above its
toe, that is an affine map: ((c + 0.055) g^(1/2.4)) − 0.055. Gains have mean zero (in logarithms) over source images, or
scene and gains could drift apart together.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Effect, Fitted, Measured
from genre_tasks.scene.chunk import Gain, View

_TOE, _POWER = 0.055, 2.4
LARGEST = 4.0
"""Logarithm of the largest gain that is applied, and of the smallest: a factor of 55."""


def toned(color: Tensor, log_gain: Tensor) -> Tensor:
    """sRGB [..., 3] as an image of that gain [..., 3] shows it, not clamped. Differentiable in both."""
    return (color + _TOE) * slope(log_gain) - _TOE


def slope(log_gain: Tensor) -> Tensor:
    """Derivative of the shown by the scene's own colour."""
    return torch.exp(log_gain.clamp(-LARGEST, LARGEST) / _POWER)


def neutral(image: Tensor, log_gain: Tensor) -> Tensor:
    """The scene's own colours in [0, 1] of what an image [..., 3] shows; where it is clipped they stay clipped."""
    own = (image + _TOE) / slope(log_gain) - _TOE
    return torch.where(image >= 1, torch.maximum(own, image), own).clamp(0, 1)


def measure(seen: Seen) -> Measured:
    """The spread of log gain over images that share points, of the channel where it is widest."""
    linked = seen.linked
    if linked.sum() < 2:
        return Measured(None, "no two images share enough points of LiDAR sweeps")
    spread = seen.gains[linked].std(0)
    channel = int(spread.argmax())
    return Measured(100 * float(spread[channel]), f"of {int(linked.sum())} images, widest in {'RGB'[channel]}")


def fit(seen: Seen) -> Fitted:
    """Gains of all views: source views' own, others' between those of their camera's neighbours in time."""
    known: dict[str, list[tuple[float, Gain]]] = {}
    for view, gain, linked in zip(seen.sources, seen.gains, seen.linked, strict=True):
        if linked:
            red, green, blue = (float(g) for g in gain)
            known.setdefault(view.camera, []).append((view.timestamp_s, (red, green, blue)))
    return Fitted(gains={(v.camera, v.frame): _at(v, known[v.camera]) for v in seen.chunk.views if v.camera in known})


def _at(view: View, known: list[tuple[float, Gain]]) -> Gain:
    times, gains = [t for t, _ in sorted(known)], np.array([g for _, g in sorted(known)])
    red, green, blue = (float(np.interp(view.timestamp_s, times, gains[:, k])) for k in range(3))
    return red, green, blue


EFFECT = Effect(
    "exposure", "spread of gain between images", "%", 8.0, "an affine colour map an image", measure, fit=fit
)
