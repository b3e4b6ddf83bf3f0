"""The peer: gsplat's own torch reference (``gsplat.cuda._torch_impl``), completed where it has only CUDA code.

Three things are missing on a CPU. ``rasterize_to_indices_in_range``, which lists the (Gaussian, pixel) pairs that are
blended, is written here after its CUDA code; its list is made once per scene and **its time is not counted, in the
peer's favour**. Two functions of nerfacc (CUDA too) are a scan and a scatter-add of torch here, and are timed: they are
part of its compositing.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.bench import NotMeasuredError
from benchmarks.raster.scenes import ATTRIBUTES, Scene
from genre_tasks.scene.gaussians import Splats

VERSION = "1.5.3"
ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.999
STOP = 1e-4
"""gsplat's constants (``cuda/include/Common.h``, ``RasterizeToIndices3DGS.cu``)."""
BLOCK_PX = 16


@dataclass(frozen=True)
class Pairs:
    """M blended (Gaussian, pixel) pairs, pixel after pixel in row-major order, each front to back; int64."""

    gaussians: Tensor  # [M]
    pixels: Tensor  # [M]
    images: Tensor  # [M] all zero: one view


def load_reference() -> Any:
    """Imports gsplat's torch reference.

    Returns:
        The module.

    Raises:
        NotMeasuredError: gsplat, or this version of it, is not installed.
    """
    from importlib.metadata import PackageNotFoundError, version

    try:
        found = version("gsplat").split("+")[0]  # wheels with CUDA code are called 1.5.3+pt24cu124
    except PackageNotFoundError:
        found = "no"
    if found != VERSION:
        raise NotMeasuredError(f"needs gsplat {VERSION}, found {found} version: pip install 'genre[bench]'")
    # gsplat imports nerfacc by name when the reference is called, so a stand-in must be there first.
    stand_in = ModuleType("nerfacc")
    vars(stand_in).update(render_weight_from_alpha=_weights, accumulate_along_rays=_accumulate)
    sys.modules["nerfacc"] = stand_in
    from gsplat.cuda import _torch_impl

    return _torch_impl


def render_reference(gsplat: Any, splats: Splats, s: Scene, pairs: Pairs) -> tuple[Tensor, Tensor]:
    """Renders the scene's first view with the reference.

    Args:
        gsplat: the reference.
        splats: to render.
        s: with the cameras.
        pairs: that are blended.

    Returns:
        Colour and depth [1, H, W, 4], alpha [1, H, W, 1].
    """
    c = s.cameras
    _, centers, depths, conics = _project(gsplat, splats, s)
    features = torch.cat([splats.colors[None], depths[..., None]], -1)
    out: tuple[Tensor, Tensor] = gsplat.accumulate(
        centers,
        conics,
        splats.opacities[None],
        features,
        pairs.gaussians,
        pairs.pixels,
        pairs.images,
        c.width_px,
        c.height_px,
    )
    return out


def forward_backward_reference(gsplat: Any, leaves: Splats, s: Scene, pairs: Pairs) -> None:
    """Renders, and leaves fresh gradients of all 14 attributes in ``leaves``.

    Args:
        gsplat: the reference.
        leaves: to render; their gradients are replaced.
        s: with the cameras and the weights of the images.
        pairs: that are blended.
    """
    for name in ATTRIBUTES:
        # Gradients would otherwise add up over calls, which costs time and changes values.
        getattr(leaves, name).grad = None
    image, alpha = render_reference(gsplat, leaves, s, pairs)
    weights = torch.cat([s.v_color, s.v_depth[..., None]], -1)
    torch.autograd.backward((image, alpha), (weights, s.v_alpha[..., None]))


def _project(gsplat: Any, splats: Splats, s: Scene) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Radii [1, N, 2], centres [1, N, 2], depths [1, N] and conics [1, N, 3] in the first view."""
    c = s.cameras
    fx, fy = c.focal_px[0].tolist()
    cx, cy = c.center_px[0].tolist()
    intrinsics = torch.tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]])
    covariances, _ = gsplat._quat_scale_to_covar_preci(splats.quats, splats.scales, compute_preci=False)
    pose = c.camera_SE3_chunk[:1]
    out: tuple[Tensor, ...] = gsplat._fully_fused_projection(
        splats.means, covariances, pose, intrinsics, c.width_px, c.height_px
    )
    return out[0], out[1], out[2], out[3]


@torch.no_grad()
def list_pairs(gsplat: Any, s: Scene) -> Pairs:
    """Lists what ``rasterize_to_indices_in_range`` lists, block of pixels by block of pixels.

    Args:
        gsplat: the reference.
        s: with one view.

    Returns:
        Pairs: row after row of the image, each pixel's front to back.
    """
    width = s.cameras.width_px
    height = s.cameras.height_px
    radii, centers, depths, conics = (x[0] for x in _project(gsplat, s.splats, s))
    shown = torch.nonzero((radii > 0).all(1))[:, 0]
    # Stable, so that Gaussians at equal depth blend in one order every time.
    shown = shown[torch.argsort(depths[shown], stable=True)]
    center, conic, opacity, radius = (x[shown] for x in (centers, conics, s.splats.opacities, radii))
    low = center - radius
    high = center + radius
    gaussians = []
    pixels = []
    for y in range(0, height, BLOCK_PX):
        # Culling by bands first keeps the search in each block short.
        in_band = torch.nonzero((high[:, 1] >= y) & (low[:, 1] <= y + BLOCK_PX))[:, 0]
        for x in range(0, width, BLOCK_PX):
            # Without culling, each block would test all Gaussians at each of its pixels.
            near = in_band[(high[in_band, 0] >= x) & (low[in_band, 0] <= x + BLOCK_PX)]
            ys = torch.arange(y, min(y + BLOCK_PX, height))
            xs = torch.arange(x, min(x + BLOCK_PX, width))
            pixel_yx = torch.cartesian_prod(ys, xs)
            blended = _blended(pixel_yx.flip(1) + 0.5, center[near], conic[near], opacity[near])
            pixel, k = torch.nonzero(blended, as_tuple=True)
            gaussians.append(shown[near[k]])
            pixels.append((pixel_yx[:, 0] * width + pixel_yx[:, 1])[pixel])
    pixels_of_all = torch.cat(pixels)
    # Row after row of the image, as gsplat lists them; a stable sort keeps each pixel's order of depth.
    order = torch.argsort(pixels_of_all, stable=True)
    return Pairs(torch.cat(gaussians)[order], pixels_of_all[order], torch.zeros_like(order))


def _blended(at: Tensor, center: Tensor, conic: Tensor, opacity: Tensor) -> Tensor:
    """[P, K] whether Gaussian k, front to back, is blended into the pixel with centre ``at`` [P, 2]."""
    dx, dy = (at[:, None] - center[None]).unbind(-1)
    sigma = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
    alpha = (opacity * torch.exp(-sigma)).clamp_max(ALPHA_MAX)
    drawn = (sigma >= 0) & (alpha >= ALPHA_MIN)
    # A pair is blended while enough light is left behind it, as in gsplat's CUDA code.
    after = torch.cumprod(torch.where(drawn, 1 - alpha, 1.0), -1)
    return drawn & (after > STOP)


def _weights(alphas: Tensor, *, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """nerfacc's ``render_weight_from_alpha``: weights [M] and transmittances [M] before each pair, per ray."""
    # In float32 the running sum over all rays would lose the last digits.
    logs = torch.log1p(-alphas.double())
    before = torch.cumsum(logs, 0) - logs
    first = torch.ones_like(ray_indices, dtype=torch.bool)
    first[1:] = ray_indices[1:] != ray_indices[:-1]
    starts = torch.nonzero(first)[:, 0]
    segment = torch.cumsum(first, 0) - 1
    # One scan over all rays, less its value at the ray's start, avoids a loop over rays.
    transmittance = torch.exp(before - before[starts][segment]).float()
    return alphas * transmittance, transmittance


def _accumulate(weights: Tensor, values: Tensor | None, *, ray_indices: Tensor, n_rays: int) -> Tensor:
    """nerfacc's ``accumulate_along_rays``: [M] and [M, C] (or ``None`` for ones) → [rays, C]."""
    source = weights[:, None] if values is None else weights[:, None] * values
    return torch.zeros(n_rays, source.shape[1]).index_add(0, ray_indices, source)
