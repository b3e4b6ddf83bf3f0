"""Oracles: what any correct renderer may and may not do, worked out in float64 and blind to the image that is judged.

Two correct renderers differ where a comparison decides: a layer's alpha beside ``ALPHA_MIN`` (or, in gradients, beside
``ALPHA_MAX``), a transmittance beside the stop, two depths too near to be told apart. :func:`survey` finds these pixels
from a first-order bound on what rounding can do to each layer; everywhere else images have to agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from genre_tasks.render import constants as const
from genre_tasks.render.reference import BLOCK_PX, _Footprints, _project, _render_block
from genre_tasks.render.types import Cameras, Render
from genre_tasks.scene.gaussians import Splats

ULP = 2.0**-24
_WIDER = 1e-2
"""Opacities are raised by this while footprints are collected, so that layers just below the cut are looked at too."""

Box = tuple[int, int, int, int]  # x from, x to, y from, y to


@dataclass(frozen=True)
class Survey:
    """What float64 says about the layers of each pixel and about each Gaussian."""

    band: Tensor  # [V, H, W] bool: rounding may decide otherwise here
    layers: Tensor  # [V, H, W] int64: at most so many layers
    peak: Tensor  # [V, H, W] no layer's alpha is greater
    drawn: Tensor  # [N] bool: has weight in some pixel outside of the band, whatever the rounding
    absent: Tensor  # [N] bool: has weight in no pixel, whatever the rounding


@dataclass(frozen=True)
class Agreement:
    """Largest absolute errors outside and inside of the band, and the band's share of the pixels."""

    outside: float
    inside: float
    share: float


def survey(
    splats: Splats, cameras: Cameras, ulps: float = 8.0, margin: float = 0.0, bands: Sequence[int] | None = None
) -> Survey:
    """Walks the float64 reference's layers.

    ``ulps`` float32 roundings (2^−24) are allowed in each of the quantities that a layer is made of; ``margin`` widens
    the thresholds by a relative amount, for finite differences. ``bands`` as in :func:`reference_bands`; outside of
    them nothing is looked at, and no Gaussian is called ``absent`` or ``drawn`` for what happens there. What a lens's
    distortion and a rolling shutter add to rounding is not looked at, nor depths that tie under a shutter.
    """
    splats = splats.to(torch.float64)
    count, shape = len(splats), (len(cameras), cameras.height_px, cameras.width_px)
    out = Survey(
        torch.zeros(shape, dtype=torch.bool),
        torch.zeros(shape, dtype=torch.int64),
        torch.zeros(shape, dtype=torch.float64),
        torch.zeros(count, dtype=torch.bool),
        torch.ones(count, dtype=torch.bool),
    )
    # The colours carry the index of each Gaussian through the projection, which drops and sorts.
    index = torch.arange(count, dtype=torch.float64)[:, None].expand(-1, 3)
    carried = torch.where(splats.colors.isfinite().all(1, keepdim=True), index, torch.nan)
    wide = replace(splats, opacities=splats.opacities * (1 + _WIDER), colors=carried)
    with torch.no_grad():
        for v in range(len(cameras)):
            front = _project(wide, cameras, v, dict.fromkeys(const.CULL_REASONS, 0))
            doubt = _doubt(splats, cameras, v)
            for box, inside in _blocks(front, cameras, bands):
                at = front.features[inside, 0].long()
                _look(front, inside, at, doubt[at], box, (v, ulps, margin), out)
    return out


def reference_bands(splats: Splats, cameras: Cameras, bands: Sequence[int]) -> Render:
    """The reference's image in the bands of ``BLOCK_PX`` rows with these numbers, zero elsewhere; differentiable.

    For images too large to be rendered whole: give the other rows no weight in the loss.
    """
    images, culled = [], dict.fromkeys(const.CULL_REASONS, 0)
    for v in range(len(cameras)):
        front = _project(splats, cameras, v, culled)
        image = splats.means.new_zeros(cameras.height_px, cameras.width_px, 5)
        for box, inside in _blocks(front, cameras, bands):
            image[box[2] : box[3], box[0] : box[1]] = _render_block(front, inside, box)
        images.append(image)
    image = torch.stack(images)
    return Render(image[..., :3], image[..., 4], image[..., 3], {k: n for k, n in culled.items() if n})


def agreement(image: Render, truth: Render, band: Tensor) -> Agreement:
    """Of colour, alpha, and depth as a share of the farthest one (at least 1 m)."""
    far = max(1.0, float(truth.depth.detach().abs().max())) if truth.depth.numel() else 1.0
    error = torch.zeros(band.shape, dtype=torch.float64)
    for name, unit in (("color", 1.0), ("alpha", 1.0), ("depth", far)):
        found, exact = (getattr(x, name).detach().double().cpu() for x in (image, truth))
        # A NaN must fail a comparison with a bound.
        difference = torch.nan_to_num((found - exact).abs() / unit, nan=torch.inf)
        error = torch.maximum(error, difference.amax(-1) if name == "color" else difference)
    outside, inside = (float(error[m].max()) if bool(m.any()) else 0.0 for m in (~band, band))
    return Agreement(outside, inside, float(band.double().mean()) if band.numel() else 0.0)


def relative_l2(found: Tensor, exact: Tensor) -> float:
    """‖found − exact‖ / ‖exact‖; 0 where both are zero, infinite where only ``exact`` is or something is not finite."""
    found, exact = found.detach().double().cpu(), exact.detach().double().cpu()
    # In units of the largest entry: squares of gradients of 1e-200 would underflow.
    unit = float(exact.abs().amax()) if exact.numel() else 0.0
    if unit == 0.0:
        return 0.0 if not bool(found.any()) else torch.inf
    error = torch.linalg.vector_norm((found - exact) / unit) / torch.linalg.vector_norm(exact / unit)
    return float(torch.nan_to_num(error, nan=torch.inf))


def cosine(found: Tensor, exact: Tensor) -> float:
    """Of the angle between two gradients as vectors; NaN if one of them is zero."""
    found, exact = found.detach().double().flatten().cpu(), exact.detach().double().flatten().cpu()
    found, exact = found / found.abs().amax(), exact / exact.abs().amax()
    return float(found @ exact / (torch.linalg.vector_norm(found) * torch.linalg.vector_norm(exact)))


def sparsity_faults(gradients: Mapping[str, Tensor], seen: Survey) -> tuple[int, int]:
    """How many Gaussians have a gradient though they are absent, and have none at all though they are drawn."""
    touched = torch.zeros_like(seen.drawn)
    for gradient in gradients.values():
        nonzero = gradient.detach().cpu() != 0
        touched |= nonzero if nonzero.ndim == 1 else nonzero.any(1)
    return int((touched & seen.absent).sum()), int((~touched & seen.drawn).sum())


def alpha_excess(alpha: Tensor, seen: Survey) -> float:
    """Largest excess of alpha over 1 − (1 − p)^N, for N layers of at most p each; negative if there is none."""
    return float((alpha.detach().double().cpu() - 1 + (1 - seen.peak) ** seen.layers).max())


def _blocks(front: _Footprints, cameras: Cameras, bands: Sequence[int] | None) -> list[tuple[Box, Tensor]]:
    """Each block of the bands (all by default) and the footprints that can reach it, front to back."""
    low, high = (front.center - front.half_extent).detach(), (front.center + front.half_extent).detach()
    width, height = cameras.width_px, cameras.height_px
    out = []
    for y in range(0, height, BLOCK_PX) if bands is None else [BLOCK_PX * b for b in bands]:
        y_end = min(y + BLOCK_PX, height)
        in_band = torch.nonzero((high[:, 1] >= y + 0.5) & (low[:, 1] <= y_end - 0.5))[:, 0]
        for x in range(0, width, BLOCK_PX):
            x_end = min(x + BLOCK_PX, width)
            out.append(
                ((x, x_end, y, y_end), in_band[(high[in_band, 0] >= x + 0.5) & (low[in_band, 0] <= x_end - 0.5)])
            )
    return out


def _doubt(splats: Splats, cameras: Cameras, v: int) -> Tensor:
    """[N, 4]: what one relative rounding can do to centre x, centre y (px), to M = J R S (px) and to z (m).

    Sums are bounded by the sums of their terms' sizes, so that cancellation counts.
    """
    pose = cameras.camera_SE3_chunk[v].to(splats.means)
    (fx, fy), center = cameras.focal_px[v].to(splats.means), cameras.center_px[v].to(splats.means)
    position = splats.means @ pose[:3, :3].T + pose[:3, 3]
    size = splats.means.abs() @ pose[:3, :3].abs().T + pose[:3, 3].abs()
    z = position[:, 2]
    columns = []
    for k, f in enumerate((fx, fy)):
        slope = position[:, k] / z
        columns.append(f / z * (size[:, k] + slope.abs() * size[:, 2]) + center[k].abs() + (f * slope).abs())
    spread = splats.scales.abs().amax(1) * torch.maximum(fx, fy) / z * (1 + size[:, 2] / z)
    return torch.stack([*columns, spread, size[:, 2]], 1).abs()


def _look(
    front: _Footprints, inside: Tensor, at: Tensor, doubt: Tensor, box: Box, how: tuple[int, float, float], out: Survey
) -> None:
    """One block: [h, w, K] of its pixels and layers."""
    (v, ulps, margin), (x0, x1, y0, y1) = how, box
    if not len(inside):
        return
    center, (a, b, c), z = front.center[inside], front.conic[inside].unbind(1), front.features[inside, 3]
    opacity = front.opacity[inside] / (1 + _WIDER)
    dx = (torch.arange(x0, x1) + 0.5)[None, :, None] - center[:, 0]
    dy = (torch.arange(y0, y1) + 0.5)[:, None, None] - center[:, 1]
    terms = a * dx * dx / 2, b * dx * dy, c * dy * dy / 2
    raw = opacity * torch.exp(-sum(terms).clamp(min=0))  # type: ignore[union-attr]
    size = terms[0] + terms[1].abs() + terms[2]
    gx, gy = (a * dx + b * dy).abs(), (b * dx + c * dy).abs()  # change of the exponent by pixel of the centre
    # Covariance M Mᵀ changes by 2 M dM, the exponent by qᵀ M dM q for q = conic d.
    spread = (2 * size).sqrt() * torch.hypot(gx, gy) * doubt[:, 2]
    tolerance = ulps * ULP * (1 + size + gx * doubt[:, 0] + gy * doubt[:, 1] + spread)

    low, high = 1 - tolerance - margin, 1 + tolerance + margin
    alpha = torch.where(raw >= const.ALPHA_MIN, raw.clamp(max=const.ALPHA_MAX), 0.0)
    maybe, sure = raw * high >= const.ALPHA_MIN, raw * low >= const.ALPHA_MIN
    after = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)
    # A clamped alpha is exact.
    moved = torch.where(raw * low > const.ALPHA_MAX, ulps * ULP, tolerance + margin)
    loose = torch.cumsum(alpha / (1 - alpha) * moved + ulps * ULP * (alpha > 0), -1)
    loose_before = torch.cat([torch.zeros_like(loose[..., :1]), loose[..., :-1]], -1)
    reached = maybe & (before * (1 + loose_before) >= const.TRANSMITTANCE_STOP)
    live = reached & (after * (1 + loose) >= const.TRANSMITTANCE_STOP)  # a layer that would leave less is not drawn
    cut = maybe & ~sure
    clamp = (raw * low <= const.ALPHA_MAX) & (raw * high >= const.ALPHA_MAX)
    stop = (after / const.TRANSMITTANCE_STOP - 1).abs() <= loose + margin
    # Sorted by z: the last layer that may be drawn before this one. Equal depths keep the input's order.
    last = torch.cummax(torch.where(maybe, z, 0.0), -1).values
    gap = z - torch.cat([torch.zeros_like(last[..., :1]), last[..., :-1]], -1)
    tie = (gap > 0) & (gap <= ulps * ULP * doubt[:, 3])

    pixels = (v, slice(y0, y1), slice(x0, x1))
    out.band[pixels] = (reached & (cut | clamp | stop | tie)).any(-1)
    out.layers[pixels] = live.sum(-1)
    out.peak[pixels] = torch.where(live, (raw * high).clamp(max=const.ALPHA_MAX), 0.0).amax(-1)
    surely = sure & (after * (1 - loose) >= const.TRANSMITTANCE_STOP) & ~out.band[pixels][..., None]
    out.drawn[at[surely.any(0).any(0)]] = True
    out.absent[at[live.any(0).any(0)]] = False
