"""A soft contact shadow: dark flat Gaussians on the ground under an actor, part of its node.

It is no cast shadow: it knows no sun, and is as dark at noon as under clouds. What it does is to bind an actor to the
ground. The cast shadow that an actor had in the recording is baked into the ground's colours, and stays where it was
when the actor is moved or removed.
"""

from __future__ import annotations

import math

import torch

from genre_tasks.scene.gaussians import Gaussians

SHADOW_COLOR = (0.02, 0.02, 0.025)
"""sRGB; a little blue, as the sky lights what the sun does not."""

_SPACING_M = 0.45
_SPREAD = 0.9
_THICKNESS_M = 0.01
_ABOVE_GROUND_M = 0.04
# A little wider than the box, since what is under it is seen from the side alone.
_EXTENT = 1.1
_MAX_COUNT = 400


def build_contact_shadow(size_m: tuple[float, float, float], clearance_m: float, darkness: float) -> Gaussians:
    """Builds the shadow of a box.

    Args:
        size_m: length, width and height of the box.
        clearance_m: from the ground up to the box's bottom; negative where the box reaches below the ground.
        darkness: how much of the ground's light is gone under the middle, 0 to 1.

    Returns:
        Gaussians in the box; none where ``darkness`` is 0.

    >>> len(build_contact_shadow((4.5, 1.8, 1.5), 0.0, 0.5)), len(build_contact_shadow((4.5, 1.8, 1.5), 0.0, 0.0))
    (44, 0)
    """
    if not darkness:
        return Gaussians.unpack(torch.zeros(0, 14))
    spacing = _SPACING_M
    # A long vehicle gets larger Gaussians, not more of them.
    spacing *= max(1.0, math.sqrt(size_m[0] * size_m[1] / (_MAX_COUNT * spacing**2)))
    counts = [max(2, round(_EXTENT * size / spacing)) for size in size_m[:2]]
    steps = [_EXTENT * size / count for size, count in zip(size_m, counts, strict=False)]
    axes = [(torch.arange(n, dtype=torch.float32) - (n - 1) / 2) * step for n, step in zip(counts, steps, strict=True)]
    x, y = torch.meshgrid(*axes, indexing="ij")
    scales = [_SPREAD * step for step in steps]
    # At a point of an endless grid the Gaussians of this spread sum to 2π · spread²: their optical depths add up.
    depth = -math.log1p(-min(darkness, 0.98)) / (2 * math.pi * _SPREAD**2)
    opacity = 1 - math.exp(-depth)
    count = x.numel()
    means = torch.stack(
        [x.flatten(), y.flatten(), torch.full((count,), -size_m[2] / 2 - clearance_m + _ABOVE_GROUND_M)], 1
    )
    log_scales = torch.tensor([*scales, _THICKNESS_M]).log().expand(count, 3)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4)
    logits = torch.full((count,), math.log(opacity / (1 - opacity)))
    return Gaussians(
        means, log_scales.clone(), quats.clone(), logits, torch.tensor(SHADOW_COLOR).expand(count, 3).clone()
    )
