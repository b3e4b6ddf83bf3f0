"""From rendered views to what the network is given, and from its output back to images: all of it without weights.

Images are sRGB in [0, 1], [B, 3, H, W]; masks and alphas are [B, 1, H, W].
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from genre_tasks.fixer.network import Conditions
from genre_tasks.fixer.source_images import references
from genre_tasks.fixer.warping import MIN_ALPHA, SourceImage, Warp, choose, surface_of, warp
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_views import NovelViews

MAX_COLOUR_SHIFT = 0.03
"""Largest change of an image's mean per channel, where the render is more than half opaque. A fixer repairs structure;
a larger drift of the whole image is an error of the network (about 8 of 255 levels, just visible side by side)."""


HOLE_ALPHA = 0.5
"""What is thinner than this is a hole, the more so the thinner."""


@dataclass(frozen=True)
class Degraded:
    """B rendered views with what they are fixed from, all of one size; colours premultiplied by their alpha."""

    color: Tensor  # [B, 3, H, W]
    alpha: Tensor  # [B, 1, H, W]
    lidar_color: Tensor  # [B, 3, H, W]
    lidar_alpha: Tensor  # [B, 1, H, W]
    reference: Tensor  # [B, 3, H, W] the nearest source image, from its own viewpoint
    warped: Tensor  # [B, 3, H, W] source images looked up by rendered depth, black where none sees the point
    warp_mask: Tensor  # [B, 1, H, W]
    warp_spread: Tensor  # [B, 1, H, W] how far the images that see a point disagree
    lidar_warped: Tensor  # [B, 3, H, W] the same by the LiDAR map's depth: sparser, free of floaters
    lidar_warp_mask: Tensor  # [B, 1, H, W]
    lidar_warp_spread: Tensor  # [B, 1, H, W]
    depth_gap: Tensor  # [B, 1, H, W] between rendered depth and the LiDAR map's, see :func:`depth_gap`

    def at(self, index: slice) -> Degraded:
        """The views of a slice."""
        return Degraded(*(getattr(self, f.name)[index] for f in fields(self)))

    def cropped(self, top: int, left: int, height: int, width: int) -> Degraded:
        """The same window of every image."""
        return Degraded(*(getattr(self, f.name)[..., top : top + height, left : left + width] for f in fields(self)))


def fill_holes(
    color: Tensor,  # [B, 3, H, W] premultiplied
    alpha: Tensor,  # [B, 1, H, W]
    lidar_color: Tensor,  # [B, 3, H, W] premultiplied
    lidar_alpha: Tensor,  # [B, 1, H, W]
) -> Tensor:  # [B, 3, H, W]
    """The render over the LiDAR map over the surrounding colours: an image without holes.

    A hole is where alpha is under ``HOLE_ALPHA``. Above it a render is not touched: scenes are optimised on black, and
    their colours make up for what is missing to full alpha.

    What neither covers takes the alpha-weighted mean of ever larger neighbourhoods (pull–push), and
    black where nothing was drawn at all.
    """
    solid = (alpha / HOLE_ALPHA).clamp(0, 1)
    over = color + (1 - solid) * lidar_color
    cover = solid + (1 - solid) * lidar_alpha
    return (over + (1 - cover) * _pull_push(over, cover)).clamp(0, 1)


def _pull_push(color: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean colour near each pixel, from the finest level of a pyramid that holds any weight."""
    height, width = color.shape[-2:]
    local = color / weight.clamp_min(1e-4)
    if height == 1 and width == 1:
        return local * (weight > 1e-4)
    pad = (0, width % 2, 0, height % 2)
    pooled = [F.avg_pool2d(F.pad(x, pad), 2) for x in (color, weight)]
    coarse = F.interpolate(_pull_push(*pooled), scale_factor=2, mode="nearest")[..., :height, :width]
    trust = (8 * weight).clamp(0, 1)  # an eighth of a cell covered is enough to speak for it
    return torch.where(weight > 1e-4, trust * local + (1 - trust) * coarse, coarse)


def degraded(chunk: Chunk, novel: NovelViews, indices: Sequence[int], sources: Sequence[SourceImage]) -> Degraded:
    """The views ``indices`` with what they are fixed from; ``sources`` are the chunk's (see :func:`recorded`)."""
    at = list(indices)
    near = references(chunk, [novel.views[i] for i in at], sources)
    warps = [_warps(chunk, novel, i, sources) for i in at]
    by_render, by_lidar = ([pair[k] for pair in warps] for k in (0, 1))
    return Degraded(
        novel.color[at].permute(0, 3, 1, 2),
        novel.alpha[at].unsqueeze(1),
        novel.lidar_color[at].permute(0, 3, 1, 2),
        novel.lidar_alpha[at].unsqueeze(1),
        torch.stack([s.image for s in near]).to(novel.color),
        *_stacked(by_render),
        *_stacked(by_lidar),
        depth_gap(novel.depth[at], novel.alpha[at], novel.lidar_depth[at], novel.lidar_alpha[at]).unsqueeze(1),
    )


def _warps(chunk: Chunk, novel: NovelViews, index: int, sources: Sequence[SourceImage]) -> tuple[Warp, Warp]:
    """The sources as a view would see them, by rendered depth and by the LiDAR map's."""
    view, actors = novel.views[index], chunk.actors
    by_render, by_lidar = (
        surface_of(depth[index], alpha[index], view.chunk_SE3_camera, view.lens, actors, view.frame)
        for depth, alpha in ((novel.depth, novel.alpha), (novel.lidar_depth, novel.lidar_alpha))
    )
    chosen = choose(by_lidar, sources, view.reference, actors, view.frame)
    return warp(by_render, chosen, actors, view.frame), warp(by_lidar, chosen, actors, view.frame)


def _stacked(warps: Sequence[Warp]) -> tuple[Tensor, Tensor, Tensor]:
    return (
        torch.stack([w.color for w in warps]),
        torch.stack([w.mask for w in warps]),
        torch.stack([w.spread for w in warps]),
    )


def depth_gap(depth: Tensor, alpha: Tensor, lidar_depth: Tensor, lidar_alpha: Tensor) -> Tensor:
    """How far the render's depth is from the LiDAR map's, in [0, 1]: 1 from a quarter on; 0 where either is unknown."""
    known = (alpha >= MIN_ALPHA) & (lidar_alpha >= MIN_ALPHA) & (depth > 0) & (lidar_depth > 0)
    ratio = torch.where(known, depth / lidar_depth.clamp_min(1e-6), torch.ones_like(depth)).clamp_min(1e-6)
    return (4 * ratio.log().abs()).clamp(0, 1)


def given(views: Degraded, inputs: Collection[str]) -> Degraded:
    """The views without what follows from an input that is not among ``inputs`` (see ``network.INPUTS``): that is 0."""
    from_ = {
        "render": ("color", "alpha", "warped", "warp_mask", "warp_spread", "depth_gap"),
        "reference": (
            "reference",
            "warped",
            "warp_mask",
            "warp_spread",
            "lidar_warped",
            "lidar_warp_mask",
            "lidar_warp_spread",
        ),
        "lidar": (
            "lidar_color",
            "lidar_alpha",
            "lidar_warped",
            "lidar_warp_mask",
            "lidar_warp_spread",
            "depth_gap",
        ),
    }
    blank = {name for source, names in from_.items() if source not in inputs for name in names}
    return replace(views, **{name: torch.zeros_like(getattr(views, name)) for name in blank})


def conditions(views: Degraded) -> Conditions:
    """The network's input, of the same size."""
    render = fill_holes(views.color, views.alpha, views.lidar_color, views.lidar_alpha)
    aligned = [views.alpha, views.lidar_alpha, views.warped, views.warp_mask, views.lidar_warped, views.lidar_warp_mask]
    spread = [4 * views.warp_spread, 4 * views.lidar_warp_spread, views.depth_gap]
    hints = torch.cat([*aligned, *_evidence(render, views), *spread], 1)
    return Conditions(render, views.reference, views.lidar_color, hints)


def _evidence(render: Tensor, views: Degraded) -> list[Tensor]:
    """Six maps [B, 1, H, W] of about unit size that say where to trust which source.

    How far LiDAR map and warps disagree with the render in the mean of a neighbourhood, and how sharp render and warps
    are (mean distance to the neighbourhood's mean): a blurred render beside a sharp, agreeing warp asks for a copy, a
    sharp one for none.
    """
    warps = [(views.warped, views.warp_mask), (views.lidar_warped, views.lidar_warp_mask)]
    sources = [(views.lidar_color, views.lidar_alpha), *warps]
    disagreement = [4 * _smooth(image - cover * render).abs().mean(1, keepdim=True) for image, cover in sources]
    filled = [image + (1 - cover) * render for image, cover in warps]
    sharpness = [16 * _smooth((x - _smooth(x)).abs().mean(1, keepdim=True)) for x in (render, *filled)]
    return disagreement + sharpness


def _smooth(image: Tensor) -> Tensor:
    """The mean of 5 × 5 pixels, edges repeated."""
    return F.avg_pool2d(F.pad(image, (2, 2, 2, 2), mode="replicate"), 5, 1)


def padded(inputs: Conditions, stride: int) -> Conditions:
    """Padded at the right and below to multiples of ``stride`` by repeating the edge."""
    height, width = inputs.render.shape[-2:]
    pad = (0, -width % stride, 0, -height % stride)
    tensors = (inputs.render, inputs.reference, inputs.lidar, inputs.hints)
    return Conditions(*(F.pad(x, pad, mode="replicate") for x in tensors))


def view_noise(seed: int, index: int, shape: tuple[int, int, int]) -> Tensor:
    """Standard normal noise of one view, from (seed, index) alone: no batch size changes it."""
    mixed = np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)[0]
    return torch.randn(shape, generator=torch.Generator().manual_seed(int(mixed >> np.uint64(1))))


def bound_colour_shift(fixed: Tensor, render: Tensor, alpha: Tensor, bound: float = MAX_COLOUR_SHIFT) -> Tensor:
    """``fixed`` clamped to [0, 1], its mean per channel where alpha > 0.5 at most ``bound`` away from the render's.

    A channel beyond the bound is offset by the constant that brings it back (found by bisection, because clamping at 0
    and 1 moves the mean too); others are not touched.
    """
    inside = (alpha > 0.5).to(fixed.dtype)
    count = inside.sum((2, 3)).clamp_min(1)

    def mean(image: Tensor) -> Tensor:
        return (image * inside).sum((2, 3)) / count

    fixed = fixed.clamp(0, 1)
    centre = mean(render)
    target = centre + (mean(fixed) - centre).clamp(-bound, bound)
    beyond = (mean(fixed) - target).abs() > 1e-6
    if not bool(beyond.any()):
        return fixed
    low, high = -torch.ones_like(target), torch.ones_like(target)
    for _ in range(24):
        middle = (low + high) / 2
        above = mean((fixed + middle[..., None, None]).clamp(0, 1)) > target
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return torch.where(beyond[..., None, None], (fixed + low[..., None, None]).clamp(0, 1), fixed)
