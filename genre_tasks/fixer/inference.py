"""Fixing a batch of views: conditions, one step of the network, and the bounds on what comes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import torch
from torch import Tensor

from genre_tasks.errors import NonFiniteError
from genre_tasks.fixer.conditioning import Degraded, bound_colour_shift, conditions, given, padded, view_noise
from genre_tasks.fixer.network import Conditions, Encoded, Fnet

TILE_PX = 1024
"""Images wider or higher than this are fixed in tiles: attention over all their latents would take too much memory."""

OVERLAP_PX = 128
"""Of neighbouring tiles; each fades into the next across it."""


@torch.no_grad()
def fix(
    fnet: Fnet,
    views: Degraded,
    noise: Tensor,
    reference: Encoded | None = None,
    half: bool = False,
    tile_px: int = TILE_PX,
) -> Tensor:
    """Fixed images [B, 3, H, W] in [0, 1] of any size.

    Args:
        noise: [B, *noise_shape] standard normal, of the padded size (see :func:`noise_of`).
        reference: the references of the batch, already encoded at the padded size.
        half: compute in bfloat16 where torch has it for an operation; the image differs by less than a grey level.
        tile_px: largest height and width that is fixed in one piece; at least twice ``OVERLAP_PX``.

    Raises:
        NonFiniteError: an input or the output is not finite. ValueError: tiles that are too small.
    """
    height, width = views.color.shape[-2:]
    require_finite("render", views.color)
    if "reference" not in fnet.architecture.inputs:
        reference = None  # it is blank, and so is its latent
    views = given(views, fnet.architecture.inputs)
    inputs = padded(conditions(views), fnet.stride)
    with torch.autocast(inputs.render.device.type, torch.bfloat16, enabled=half):
        out = _in_tiles(fnet, inputs, noise, reference, tile_px)[..., :height, :width]
    require_finite("fixed", out)
    return bound_colour_shift(out, inputs.render[..., :height, :width], views.alpha)


def prefers_half(device: torch.device) -> bool:
    """Whether the device computes in bfloat16 faster than in float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()


def _in_tiles(fnet: Fnet, inputs: Conditions, noise: Tensor, reference: Encoded | None, tile_px: int) -> Tensor:
    """The network on the whole image, or on overlapping tiles that are blended."""
    height, width = inputs.render.shape[-2:]
    if max(height, width) <= tile_px:
        return fnet(inputs, noise, reference)
    if tile_px < 2 * OVERLAP_PX:
        raise ValueError(f"expected tiles of at least {2 * OVERLAP_PX} px, got {tile_px}")
    total, weight = torch.zeros_like(inputs.render), torch.zeros_like(inputs.render[:, :1])
    step = fnet.latent_stride
    for top, bottom in _windows(height, tile_px, fnet.stride):
        for left, right in _windows(width, tile_px, fnet.stride):
            at = (..., slice(top, bottom), slice(left, right))
            latent_at = (..., slice(top // step, bottom // step), slice(left // step, right // step))
            piece = Conditions(*(getattr(inputs, f.name)[at] for f in fields(Conditions)))
            ref = None if reference is None else Encoded(reference.latent[latent_at], ())
            fade = _fade(top, bottom, height)[:, None] * _fade(left, right, width)[None]
            fade = fade.to(total)
            total[at] += fade * fnet(piece, noise[latent_at], ref)
            weight[at] += fade
    return total / weight


def _windows(size: int, tile: int, stride: int) -> Sequence[tuple[int, int]]:
    """Windows of at most ``tile`` that cover ``size`` and overlap, all multiples of ``stride`` like ``size``."""
    tile = min(tile // stride * stride, size)
    if tile == size:
        return [(0, size)]
    count = -(-(size - OVERLAP_PX) // (tile - OVERLAP_PX))
    starts = [round(k * (size - tile) / (count - 1) / stride) * stride for k in range(count)]
    return [(start, start + tile) for start in starts]


def _fade(start: int, end: int, size: int) -> Tensor:
    """Weights of a window's pixels: 1, and falling towards 0 over the overlap at an edge with a neighbour."""
    at = torch.arange(start, end) + 0.5
    rise = (at - start) / OVERLAP_PX if start else torch.ones(len(at))
    fall = (end - at) / OVERLAP_PX if end < size else torch.ones(len(at))
    return torch.minimum(rise, fall).clamp(max=1)


def noise_of(fnet: Fnet, seed: int, indices: Sequence[int], height: int, width: int) -> Tensor:
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
