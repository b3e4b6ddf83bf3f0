"""From what views are fixed from to the network's input, and from its output back to images: all of it without weights.

Images are sRGB in [0, 1], [B, 3, H, W]; masks and alphas are [B, 1, H, W].
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from genre_tasks.fixer.inputs import FixerInputs
from genre_tasks.fixer.network import HINT_CHANNELS, Conditions

# A fixer repairs structure: a larger drift of the whole image is an error of the network. The bound is about 8 of 255
# levels, which is just visible side by side.
MAX_COLOUR_SHIFT = 0.03
"""Largest change of an image's mean per channel, where the render is more than half opaque."""

HOLE_ALPHA = 0.5
"""Where alpha is below, a render has a hole, the more so the smaller its alpha."""


def fill_holes(
    color: Tensor,  # [B, 3, H, W] premultiplied
    alpha: Tensor,  # [B, 1, H, W]
    lidar_color: Tensor,  # [B, 3, H, W] premultiplied
    lidar_alpha: Tensor,  # [B, 1, H, W]
) -> Tensor:  # [B, 3, H, W]
    """Puts the render over the LiDAR map over the surrounding colours, so that the image has no holes.

    What neither covers takes the alpha-weighted mean of ever larger neighbourhoods (pull–push).

    Args:
        color: of the render.
        alpha: of the render; it counts as opaque from ``HOLE_ALPHA`` on.
        lidar_color: of the LiDAR map.
        lidar_alpha: of the LiDAR map.

    Returns:
        The filled render in [0, 1]; black where nothing was drawn at all.

    >>> white, clear = torch.ones(1, 3, 1, 1), torch.zeros(1, 1, 1, 1)
    >>> fill_holes(0 * white, clear, white, clear + 1).flatten().tolist()  # the LiDAR map fills a hole
    [1.0, 1.0, 1.0]
    """
    # A render above HOLE_ALPHA is not touched: scenes are optimised on black, and their colours make up for what is
    # missing to full alpha.
    solid = (alpha / HOLE_ALPHA).clamp(0, 1)
    over = color + (1 - solid) * lidar_color
    cover = solid + (1 - solid) * lidar_alpha
    return (over + (1 - cover) * _pull_push(over, cover)).clamp(0, 1)


def _pull_push(color: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean colour near each pixel, from the finest level of a pyramid that holds any weight."""
    height, width = color.shape[-2:]
    # Colours are premultiplied; dividing by the weight gives the colour of what is there.
    local = color / weight.clamp_min(1e-4)
    # The pyramid's top: nothing larger can fill it.
    if height == 1 and width == 1:
        return local * (weight > 1e-4)
    pad = (0, width % 2, 0, height % 2)
    coarse_color = F.avg_pool2d(F.pad(color, pad), 2)
    coarse_weight = F.avg_pool2d(F.pad(weight, pad), 2)
    coarse_mean = _pull_push(coarse_color, coarse_weight)
    coarse = F.interpolate(coarse_mean, scale_factor=2, mode="nearest")[..., :height, :width]
    # An eighth of a pixel covered is enough to trust its colour.
    trust = (8 * weight).clamp(0, 1)
    return torch.where(weight > 1e-4, trust * local + (1 - trust) * coarse, coarse)


def build_conditions(views: FixerInputs, with_evidence: bool = True) -> Conditions:
    """Builds the network's input from renders, LiDAR maps and sampled images, scaled to about unit size.

    Args:
        views: what V views of H × W pixels are fixed from.
        with_evidence: fill the hints that the network alone reads; without them the conditions are only composed with.

    Returns:
        Conditions of the same V, H and W.
    """
    render = fill_holes(views.color, views.alpha, views.lidar_color, views.lidar_alpha)
    aligned = [views.alpha, views.lidar_alpha, views.warped, views.warp_mask, views.lidar_warped, views.lidar_warp_mask]
    if not with_evidence:
        blank = torch.zeros_like(views.alpha).expand(-1, HINT_CHANNELS - sum(x.shape[1] for x in aligned), -1, -1)
        return Conditions(render, views.reference, views.lidar_color, torch.cat([*aligned, blank], 1))
    # Factors bring all maps to about unit size.
    uncertainty = [4 * views.warp_spread, 4 * views.lidar_warp_spread, views.depth_gap]
    hints = torch.cat([*aligned, *_evidence_maps(render, views), *uncertainty], 1)
    return Conditions(render, views.reference, views.lidar_color, hints)


def _evidence_maps(render: Tensor, views: FixerInputs) -> list[Tensor]:
    """Six maps [B, 1, H, W] of about unit size that say where to trust which source.

    Three tell how far LiDAR map and warps disagree with the render in the mean of a neighbourhood, three how sharp
    render and warps are (mean distance to the neighbourhood's mean). A blurred render with a sharp, agreeing warp calls
    for a copy, a sharp render for none.
    """
    warps = [(views.warped, views.warp_mask), (views.lidar_warped, views.lidar_warp_mask)]
    sources = [(views.lidar_color, views.lidar_alpha), *warps]
    # Means of a neighbourhood are compared: single pixels differ by noise even where a source is right.
    disagreement = [4 * _smooth(image - cover * render).abs().mean(1, keepdim=True) for image, cover in sources]
    # Filled by the render, or the edge of a warp's mask would pass for sharpness.
    filled = [image + (1 - cover) * render for image, cover in warps]
    sharpness = [16 * _smooth((x - _smooth(x)).abs().mean(1, keepdim=True)) for x in (render, *filled)]
    return disagreement + sharpness


def _smooth(image: Tensor) -> Tensor:
    """The mean of 5 × 5 pixels, edges repeated."""
    return F.avg_pool2d(F.pad(image, (2, 2, 2, 2), mode="replicate"), 5, 1)


def pad_to_stride(inputs: Conditions, stride: int) -> Conditions:
    """Pads images at the right and below to multiples of a stride, by repeating the edge.

    Args:
        inputs: of any size.
        stride: of the network.

    Returns:
        The padded conditions.

    >>> image = torch.zeros(1, 3, 5, 8)
    >>> tuple(pad_to_stride(Conditions(image, image, image, image), 4).render.shape)
    (1, 3, 8, 8)
    """
    height, width = inputs.render.shape[-2:]
    # The edge is repeated: a black border would bleed into the image through the convolutions.
    pad = (0, -width % stride, 0, -height % stride)
    tensors = (inputs.render, inputs.reference, inputs.lidar, inputs.hints)
    return Conditions(*(F.pad(x, pad, mode="replicate") for x in tensors))


def view_noise(seed: int, index: int, shape: tuple[int, int, int]) -> Tensor:
    """Draws the noise of one view, which no batch size changes.

    Args:
        seed: of all views.
        index: of the view.
        shape: see :meth:`Fnet.noise_shape`.

    Returns:
        Standard normal noise that depends on ``seed`` and ``index`` alone.

    >>> torch.equal(view_noise(0, 1, (1, 2, 2)), view_noise(0, 1, (1, 2, 2)))
    True
    """
    # The seed sequence mixes both numbers, so that neighbouring views and seeds share nothing. The shift keeps the
    # result inside the signed 64 bits that torch takes.
    mixed = np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)[0]
    return torch.randn(shape, generator=torch.Generator().manual_seed(int(mixed >> np.uint64(1))))


def bound_colour_shift(fixed: Tensor, render: Tensor, alpha: Tensor, bound: float = MAX_COLOUR_SHIFT) -> Tensor:
    """Brings a fixed image's mean colour back to the render's where it drifted too far.

    Args:
        fixed: [B, 3, H, W] of the network.
        render: [B, 3, H, W] with its holes filled.
        alpha: [B, 1, H, W] of the render; means are taken where it is above 0.5.
        bound: largest distance of the two means per channel.

    Returns:
        [B, 3, H, W] in [0, 1]. A channel outside of the bound is offset by a constant, others are only clamped.

    >>> render = torch.full((1, 3, 4, 4), 0.5)
    >>> bound_colour_shift(render + 0.2, render, torch.ones(1, 1, 4, 4), 0.03).mean().item()
    0.529...
    """
    # In holes the fixer must be free to draw what the render lacks.
    inside = (alpha > 0.5).to(fixed.dtype)
    count = inside.sum((2, 3)).clamp_min(1)

    def mean(image: Tensor) -> Tensor:
        return (image * inside).sum((2, 3)) / count

    fixed = fixed.clamp(0, 1)
    render_mean = mean(render)
    target = render_mean + (mean(fixed) - render_mean).clamp(-bound, bound)
    out_of_bound = (mean(fixed) - target).abs() > 1e-6
    if not bool(out_of_bound.any()):
        return fixed
    # Bisection, because clamping at 0 and 1 moves the mean too; 24 halvings reach the resolution of float32.
    low = -torch.ones_like(target)
    high = torch.ones_like(target)
    for _ in range(24):
        middle = (low + high) / 2
        above = mean((fixed + middle[..., None, None]).clamp(0, 1)) > target
        low = torch.where(above, low, middle)
        high = torch.where(above, middle, high)
    return torch.where(out_of_bound[..., None, None], (fixed + low[..., None, None]).clamp(0, 1), fixed)
