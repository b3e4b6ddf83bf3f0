"""Fixes a batch of views: conditions, one step of the network, and the bounds on what comes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import torch
from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.fixer.conditioning import bound_colour_shift, build_conditions, pad_to_stride, view_noise
from genre_tasks.fixer.inputs import FixerInputs, mask_inputs
from genre_tasks.fixer.network import Conditions, Encoded, Fnet

# Attention over all latents of a larger image would take too much memory.
TILE_PX = 1024
"""Images that are wider or higher are fixed in tiles."""

OVERLAP_PX = 128
"""Of neighbouring tiles; each fades into the next across it."""


@torch.no_grad()
def fix(
    fnet: Fnet,
    views: FixerInputs,
    noise: Tensor,
    reference: Encoded | None = None,
    half: bool = False,
    tile_px: int = TILE_PX,
) -> Tensor:
    """Repairs views of any size.

    Args:
        fnet: the network.
        views: what B views are fixed from.
        noise: [B, *noise_shape] standard normal, of the padded size (see :func:`draw_noise`).
        reference: the references of the batch, where they are already encoded at the padded size.
        half: compute in bfloat16 where torch has it for an operation; the image differs by less than a grey level.
        tile_px: largest height and width that is fixed in one piece; at least twice ``OVERLAP_PX``.

    Returns:
        [B, 3, H, W] fixed images in [0, 1].

    Raises:
        NonFiniteError: an input or the output is not finite.
        ValueError: the tiles are too small.
    """
    height, width = views.color.shape[-2:]
    # float() copies nothing in float32; numpy, which adds the values up, knows no bfloat16.
    check_finite(views.color.float(), "render", "fnet")
    # The encoded reference would get around the mask.
    if "reference" not in fnet.architecture.inputs:
        reference = None  # the network's reference is blank, and so is its latent
    views = mask_inputs(views, fnet.architecture.inputs)
    inputs = pad_to_stride(build_conditions(views), fnet.stride)
    with torch.autocast(inputs.render.device.type, torch.bfloat16, enabled=half):
        out = _run_in_tiles(fnet, inputs, noise, reference, tile_px)[..., :height, :width]
    check_finite(out.float(), "fixed", "fnet")
    return bound_colour_shift(out, inputs.render[..., :height, :width], views.alpha)


def prefers_bfloat16(device: torch.device) -> bool:
    """Tells whether a device computes in bfloat16 faster than in float32.

    Args:
        device: of the network.

    Returns:
        True for GPUs and CPUs with instructions for it.
    """
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()


def _run_in_tiles(fnet: Fnet, inputs: Conditions, noise: Tensor, reference: Encoded | None, tile_px: int) -> Tensor:
    """Runs the network on the whole image, or on overlapping tiles that are blended."""
    height, width = inputs.render.shape[-2:]
    if max(height, width) <= tile_px:
        # In one piece where it fits: attention then sees all of the image.
        return fnet(inputs, noise, reference)
    if tile_px < 2 * OVERLAP_PX:
        raise ValueError(f"expected tiles of at least {2 * OVERLAP_PX} px, got {tile_px}")
    total = torch.zeros_like(inputs.render)
    total_weight = torch.zeros_like(inputs.render[:, :1])
    stride = fnet.latent_stride
    for top, bottom in _windows(height, tile_px, fnet.stride):
        for left, right in _windows(width, tile_px, fnet.stride):
            pixels = (..., slice(top, bottom), slice(left, right))
            latents = (..., slice(top // stride, bottom // stride), slice(left // stride, right // stride))
            tile = Conditions(*(getattr(inputs, field.name)[pixels] for field in fields(Conditions)))
            tile_reference = None if reference is None else Encoded(reference.latent[latents], ())
            weight = _fade(top, bottom, height)[:, None] * _fade(left, right, width)[None]
            weight = weight.to(total)
            total[pixels] += weight * fnet(tile, noise[latents], tile_reference)
            total_weight[pixels] += weight
    return total / total_weight


def _windows(size: int, tile: int, stride: int) -> Sequence[tuple[int, int]]:
    """Windows of at most ``tile`` that cover ``size`` and overlap, all multiples of ``stride`` like ``size``."""
    tile = min(tile // stride * stride, size)
    if tile == size:
        return [(0, size)]
    # Windows are spread evenly, so that the last one is no narrow rest with little to look at.
    count = -(-(size - OVERLAP_PX) // (tile - OVERLAP_PX))
    starts = [round(k * (size - tile) / (count - 1) / stride) * stride for k in range(count)]
    return [(start, start + tile) for start in starts]


def _fade(start: int, end: int, size: int) -> Tensor:
    """Weights of a window's pixels: 1, and falling towards 0 over the overlap at an edge with a neighbour."""
    position = torch.arange(start, end) + 0.5
    rise = (position - start) / OVERLAP_PX if start else torch.ones(len(position))
    fall = (end - position) / OVERLAP_PX if end < size else torch.ones(len(position))
    return torch.minimum(rise, fall).clamp(max=1)


def draw_noise(fnet: Fnet, seed: int, indices: Sequence[int], height: int, width: int) -> Tensor:
    """Draws the noise of views, each from the seed and its index alone.

    Args:
        fnet: the network.
        seed: of all views.
        indices: B indices of views.
        height: of the images, before they are padded.
        width: likewise.

    Returns:
        [B, C, h, w] standard normal.
    """
    stride = fnet.stride
    # Noise is of the padded size, as the latents are.
    shape = fnet.noise_shape(height + -height % stride, width + -width % stride)
    return torch.stack([view_noise(seed, index, shape) for index in indices])
