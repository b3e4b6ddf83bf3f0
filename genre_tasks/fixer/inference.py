"""Fixes a batch of views: conditions, one step of the network, and the bounds on what comes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import partial

import torch
import torch.nn.functional as F
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
    reduction: int = 1,
) -> Tensor:
    """Repairs views of any size.

    A network with a residual may look at views that are reduced: its residual and gates are enlarged, and applied to
    the views and sources at full size. What it copies from sources then stays as sharp as they are.

    Args:
        fnet: the network.
        views: what B views are fixed from.
        noise: [B, *noise_shape] standard normal, of the padded size (see :func:`draw_noise`).
        reference: the references of the batch, where they are already encoded (see :func:`encode_reference`).
        half: compute in bfloat16 where torch has it for an operation; the image differs by less than a grey level.
        tile_px: largest height and width that is fixed in one piece; at least twice ``OVERLAP_PX``.
        reduction: pixels of a view per pixel of what the network sees, along each axis.

    Returns:
        [B, 3, H, W] fixed images in [0, 1].

    Raises:
        NonFiniteError: an input or the output is not finite.
        ValueError: the tiles are too small, or the network's output cannot be enlarged.
    """
    height, width = views.color.shape[-2:]
    # float() copies nothing in float32; numpy, which adds the values up, knows no bfloat16.
    check_finite(views.color.float(), "render", "fnet")
    # The encoded reference would get around the mask.
    if "reference" not in fnet.architecture.inputs:
        reference = None  # the network's reference is blank, and so is its latent
    views = mask_inputs(views, fnet.architecture.inputs)
    # A whole image that is enlarged would be blurred; a correction may be.
    if reduction > 1 and not fnet.architecture.residual:
        raise ValueError("expected a network with a residual, whose output can be enlarged")
    inputs = build_conditions(views, with_evidence=reduction == 1)
    seen = inputs if reduction == 1 else build_conditions(views.map(partial(reduce_images, reduction=reduction)))
    rows, columns = seen.render.shape[-2:]
    with torch.autocast(inputs.render.device.type, torch.bfloat16, enabled=half):
        output = _run_in_tiles(fnet, pad_to_stride(seen, fnet.stride), noise, reference, tile_px)[..., :rows, :columns]
    if reduction > 1:
        output = F.interpolate(output, scale_factor=reduction, mode="bilinear")[..., :height, :width]
    out = fnet.compose(output, inputs)
    check_finite(out.float(), "fixed", "fnet")
    return bound_colour_shift(out, inputs.render, views.alpha)


def find_reduction(max_px: int | None, height: int, width: int) -> int:
    """Finds by which factor views are reduced for the network.

    Args:
        max_px: largest height and width that the network is to see; ``None``: any.
        height: of the views.
        width: likewise.

    Returns:
        The smallest whole factor that is large enough.

    >>> find_reduction(640, 720, 1280), find_reduction(640, 180, 320), find_reduction(None, 720, 1280)
    (2, 1, 1)
    """
    return 1 if max_px is None else -(-max(height, width) // max_px)


def reduce_images(images: Tensor, reduction: int) -> Tensor:
    """Reduces images to the means of blocks.

    Args:
        images: [B, C, H, W], premultiplied where they have an alpha.
        reduction: pixels along the side of a block; blocks at the right and below repeat the image's edge.

    Returns:
        [B, C, ⌈H / reduction⌉, ⌈W / reduction⌉].
    """
    height, width = images.shape[-2:]
    padded = F.pad(images, (0, -width % reduction, 0, -height % reduction), mode="replicate")
    return F.avg_pool2d(padded, reduction)


@torch.no_grad()
def encode_reference(fnet: Fnet, image: Tensor, reduction: int = 1) -> Encoded:
    """Encodes a reference for :func:`fix`, since many views share it.

    Args:
        fnet: the network.
        image: [3, H, W] in [0, 1].
        reduction: as for :func:`fix`.

    Returns:
        Its latent, without features.
    """
    seen = reduce_images(image[None], reduction)
    height, width = seen.shape[-2:]
    padded = F.pad(seen, (0, -width % fnet.stride, 0, -height % fnet.stride), mode="replicate")
    return Encoded(fnet.encode(padded).latent, ())


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
    """The network's output of the whole image, or of overlapping tiles that are blended."""
    height, width = inputs.render.shape[-2:]
    if max(height, width) <= tile_px:
        # In one piece where it fits: attention then sees all of the image.
        return fnet.predict(inputs, noise, reference)
    if tile_px < 2 * OVERLAP_PX:
        raise ValueError(f"expected tiles of at least {2 * OVERLAP_PX} px, got {tile_px}")
    total: Tensor | None = None
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
            output = fnet.predict(tile, noise[latents], tile_reference)
            # Only now is it known how many channels there are.
            total = output.new_zeros(*output.shape[:2], height, width) if total is None else total
            total[pixels] += weight * output
            total_weight[pixels] += weight
    assert total is not None
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


def draw_noise(fnet: Fnet, seed: int, indices: Sequence[int], height: int, width: int, reduction: int = 1) -> Tensor:
    """Draws the noise of views, each from the seed and its index alone.

    Args:
        fnet: the network.
        seed: of all views.
        indices: B indices of views.
        height: of the images, before they are padded.
        width: likewise.
        reduction: as for :func:`fix`.

    Returns:
        [B, C, h, w] standard normal.
    """
    stride = fnet.stride
    height, width = (-(-size // reduction) for size in (height, width))
    # Noise is of the padded size, as the latents are.
    shape = fnet.noise_shape(height + -height % stride, width + -width % stride)
    return torch.stack([view_noise(seed, index, shape) for index in indices])
