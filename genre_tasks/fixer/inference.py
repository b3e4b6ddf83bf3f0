"""Fixing a batch of views: conditions, one step of the network, and the bounds on what comes out."""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.errors import NonFiniteError
from genre_tasks.fixer.conditioning import Degraded, bound_colour_shift, conditions, padded, view_noise
from genre_tasks.fixer.network import Encoded, Fnet


@torch.no_grad()
def fix(fnet: Fnet, views: Degraded, noise: Tensor, reference: Encoded | None = None) -> Tensor:
    """Fixed images [B, 3, H, W] in [0, 1] of any size.

    Args:
        noise: [B, *noise_shape] standard normal, of the padded size (see :func:`noise_of`).
        reference: the references of the batch, already encoded at the padded size.

    Raises:
        NonFiniteError: an input or the output is not finite.
    """
    height, width = views.color.shape[-2:]
    require_finite("render", views.color)
    inputs = padded(conditions(views), fnet.stride)
    out = fnet(inputs, noise, reference)[..., :height, :width]
    require_finite("fixed", out)
    return bound_colour_shift(out, inputs.render[..., :height, :width], views.alpha)


def noise_of(fnet: Fnet, seed: int, indices: range, height: int, width: int) -> Tensor:
    """The noise of the views ``indices``, [B, C, h, w]: each from (seed, index) alone."""
    stride = fnet.stride
    shape = fnet.noise_shape(height + -height % stride, width + -width % stride)
    return torch.stack([view_noise(seed, index, shape) for index in indices])


def require_finite(name: str, tensor: Tensor) -> None:
    """Raises ``NonFiniteError`` naming the tensor and where it is not finite."""
    bad = ~torch.isfinite(tensor)
    if bool(bad.any()):
        first = tuple(int(i) for i in torch.nonzero(bad)[0])
        raise NonFiniteError("fnet", name, int(bad.sum()), first)
