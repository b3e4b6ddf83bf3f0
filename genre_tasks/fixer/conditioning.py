"""From rendered views to what the network is given, and from its output back to images: all of it without weights.

Images are sRGB in [0, 1], [B, 3, H, W]; masks and alphas are [B, 1, H, W].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from genre_tasks.errors import InputError
from genre_tasks.fixer.network import Conditions
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.images import decode_image
from genre_tasks.scene.views import NovelView, NovelViews

MAX_COLOUR_SHIFT = 0.03
"""Largest change of an image's mean per channel, where the render is more than half opaque. A fixer repairs structure;
a larger drift of the whole image is an error of the network (about 8 of 255 levels, just visible side by side)."""

HIDDEN_PX = 5.0
"""Parallax at which a point counts as hidden. A road seen from 1.6 m above changes by about 2 px of parallax (at 3 m
of shift) from one row of pixels to the next, and must not hide itself."""

HOLE_ALPHA = 0.5
"""What is thinner than this is a hole, the more so the thinner."""

MIN_WARP_ALPHA = 0.5
"""Rendered depth is trusted for the warp where at least half of the ray's light is accounted for."""


def _hidden(x: Tensor, y: Tensor, z: Tensor, inside: Tensor, baseline_px: float) -> Tensor:
    """Where a point [H, W], at ``x, y`` in [−1, 1] of the reference's image and depth ``z`` there, lies behind another.

    Behind: a point within one pixel is nearer by ``HIDDEN_PX`` of parallax between view and reference.
    """
    height, width = z.shape
    row = ((y + 1) / 2 * height).long().clamp(0, height - 1)
    column = ((x + 1) / 2 * width).long().clamp(0, width - 1)
    cell = (row * width + column).reshape(-1)
    nearness = torch.where(inside, 1 / z, torch.zeros_like(z))
    nearest = torch.zeros(height * width).to(z).scatter_reduce(0, cell, nearness.reshape(-1), "amax")
    spread = F.max_pool2d(nearest.reshape(1, 1, height, width), 3, 1, 1).reshape(-1)
    return baseline_px * (spread[cell].reshape(height, width) - nearness) > HIDDEN_PX


@dataclass(frozen=True)
class Degraded:
    """B rendered views with what they are fixed from, all of one size; colours premultiplied by their alpha."""

    color: Tensor  # [B, 3, H, W]
    alpha: Tensor  # [B, 1, H, W]
    lidar_color: Tensor  # [B, 3, H, W]
    lidar_alpha: Tensor  # [B, 1, H, W]
    reference: Tensor  # [B, 3, H, W] the nearest source image, from its own viewpoint
    warped: Tensor  # [B, 3, H, W] the reference warped to the view by rendered depth, black where that is undefined
    warp_mask: Tensor  # [B, 1, H, W]
    lidar_warped: Tensor  # [B, 3, H, W] the same by the LiDAR map's depth: sparser, free of floaters
    lidar_warp_mask: Tensor  # [B, 1, H, W]

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


def warp_reference(
    reference: Tensor,  # [B, 3, H, W]
    depth: Tensor,  # [B, 1, H, W] metres along z, 0 where unknown
    alpha: Tensor,  # [B, 1, H, W]
    poses: list[tuple[Float64, Float64]],  # B × (chunk_SE3_camera of the view, of the reference)
    lenses: list[tuple[Lens, Lens]],  # B × (of the view, of the reference)
) -> tuple[Tensor, Tensor]:  # [B, 3, H, W], [B, 1, H, W]
    """The reference as the view would see it, by the rendered depth, and where that is defined (elsewhere black).

    Defined is a pixel whose point lies in the reference's image and is not hidden there by a nearer point of the view
    (the view's depth, splatted into the reference; what the view does not see cannot be found to hide anything).
    """
    batch, _, height, width = depth.shape
    grids, valid = [], []
    rows = torch.arange(height, device=depth.device) + 0.5
    columns = torch.arange(width, device=depth.device) + 0.5
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    for k in range(batch):
        (view_pose, source_pose), (lens, source) = poses[k], lenses[k]
        z = depth[k, 0]
        known = torch.isfinite(z) & (z > 0) & (alpha[k, 0] >= MIN_WARP_ALPHA)
        z = torch.where(known, z, torch.ones_like(z))
        source_SE3_view = torch.as_tensor(np.linalg.inv(source_pose) @ view_pose).to(depth)
        rays = torch.stack([(u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px, torch.ones_like(u)], -1)
        points = (rays * z[..., None]) @ source_SE3_view[:3, :3].T + source_SE3_view[:3, 3]
        ahead = points[..., 2] > 0.1
        safe = torch.where(ahead, points[..., 2], torch.ones_like(z))
        x = (points[..., 0] / safe * source.fx_px + source.cx_px) / source.width_px * 2 - 1
        y = (points[..., 1] / safe * source.fy_px + source.cy_px) / source.height_px * 2 - 1
        inside = known & ahead & (x.abs() < 1) & (y.abs() < 1)
        baseline_px = float(np.linalg.norm(view_pose[:3, 3] - source_pose[:3, 3])) * source.fx_px
        inside &= ~_hidden(x, y, safe, inside, baseline_px)
        grids.append(torch.stack([x, y], -1).clamp(-2, 2))
        valid.append(inside)
    mask = torch.stack(valid)[:, None].to(reference.dtype)
    grid = torch.stack(grids).to(reference.dtype)
    warped = F.grid_sample(reference, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return warped * mask, mask


def source_views(chunk: Chunk, novel: Sequence[NovelView]) -> dict[tuple[str, int], View]:
    """The references of novel views, each once, in order of appearance. Raises ``InputError`` for a stranger."""
    views = {(v.camera, v.frame): v for v in chunk.views}
    for view in novel:
        if view.reference not in views:
            raise InputError(
                "the reference of a novel view is no view of the chunk",
                remedy="Render the novel views of this chunk again.",
                log=chunk.log,
                chunk=chunk.index,
                camera=view.reference[0],
                frame=view.reference[1],
                stage="fnet",
            )
    return {v.reference: views[v.reference] for v in novel}


def source_images(sources: Mapping[tuple[str, int], View]) -> dict[tuple[str, int], Tensor]:
    """Their images [3, H, W] at the working resolution. Raises ``InputError`` for an unreadable one."""
    return {
        key: decode_image(view.image, view.lens.width_px, view.lens.height_px).permute(2, 0, 1)
        for key, view in sources.items()
    }


def degraded(
    novel: NovelViews,
    indices: range,
    sources: Mapping[tuple[str, int], View],
    images: Mapping[tuple[str, int], Tensor],
) -> Degraded:
    """The views ``indices`` with what they are fixed from; ``images`` are the references [3, H, W]."""
    at = slice(indices.start, indices.stop)
    views = novel.views[at]
    reference = torch.stack([images[v.reference] for v in views]).to(novel.color)
    poses = [(v.chunk_SE3_camera, sources[v.reference].chunk_SE3_camera) for v in views]
    lenses = [(v.lens, sources[v.reference].lens) for v in views]
    alpha, lidar_alpha = novel.alpha[at, None], novel.lidar_alpha[at, None]
    return Degraded(
        novel.color[at].permute(0, 3, 1, 2),
        alpha,
        novel.lidar_color[at].permute(0, 3, 1, 2),
        lidar_alpha,
        reference,
        *warp_reference(reference, novel.depth[at, None], alpha, poses, lenses),
        *warp_reference(reference, novel.lidar_depth[at, None], lidar_alpha, poses, lenses),
    )


def conditions(views: Degraded) -> Conditions:
    """The network's input, of the same size."""
    render = fill_holes(views.color, views.alpha, views.lidar_color, views.lidar_alpha)
    aligned = [views.alpha, views.lidar_alpha, views.warped, views.warp_mask, views.lidar_warped, views.lidar_warp_mask]
    hints = torch.cat([*aligned, *_evidence(render, views)], 1)
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
