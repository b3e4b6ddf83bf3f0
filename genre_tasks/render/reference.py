"""The ``reference`` backend: plain torch in the dtype of its input, with autograd. The oracle of every other backend.

The same rules and constants as the kernel, written for reading: project, sort by depth, composite. Images are cut into
blocks of pixels, each with exactly those Gaussians that can reach it, and a block's intermediates are recomputed in the
backward pass, so that memory does not grow with the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from genre_tasks.render import constants as const
from genre_tasks.render.reference_camera import OneCamera
from genre_tasks.render.types import Cameras
from genre_tasks.scene.gaussians import Splats
from genre_tasks.scene.rotations import rotation_matrices

BLOCK_PX = 16


@dataclass(frozen=True)
class _Footprints:
    """K projected Gaussians, front to back."""

    center: Tensor  # [K, 2] px
    conic: Tensor  # [K, 3] inverse covariance: xx, xy, yy
    opacity: Tensor  # [K]
    features: Tensor  # [K, 4] colour, camera z
    half: Tensor  # [K, 2] half extents in px of the region where alpha ≥ ALPHA_MIN


def render_reference(splats: Splats, cameras: Cameras) -> tuple[tuple[Tensor, Tensor, Tensor], dict[str, int]]:
    """Colour [V, H, W, 3], alpha and depth [V, H, W] in the splats' dtype, and the culled counts.

    Differentiable in the splats, velocities among them, and in all of the cameras.
    """
    culled = dict.fromkeys(const.CULL_REASONS, 0)
    views = [_view(splats, cameras, v, culled) for v in range(len(cameras))]
    height, width = cameras.height_px, cameras.width_px
    image = torch.stack(views) if views else splats.means.new_zeros(0, height, width, 5)
    return (image[..., :3], image[..., 4], image[..., 3]), {k: n for k, n in culled.items() if n}


def _view(splats: Splats, cameras: Cameras, v: int, culled: dict[str, int]) -> Tensor:
    """[H, W, 5]: colour, Σ w z, alpha."""
    front = _project(splats, cameras, v, culled)
    width, height = cameras.width_px, cameras.height_px
    low, high = (front.center - front.half).detach(), (front.center + front.half).detach()
    bands = []
    for y in range(0, height, BLOCK_PX):
        blocks = []
        y_end = min(y + BLOCK_PX, height)
        in_band = torch.nonzero((high[:, 1] >= y + 0.5) & (low[:, 1] <= y_end - 0.5))[:, 0]
        for x in range(0, width, BLOCK_PX):
            x_end = min(x + BLOCK_PX, width)
            inside = in_band[(high[in_band, 0] >= x + 0.5) & (low[in_band, 0] <= x_end - 0.5)]
            blocks.append(_block(front, inside, (x, x_end, y, y_end)))
        bands.append(torch.cat(blocks, 1))
    return torch.cat(bands, 0)


def _block(front: _Footprints, inside: Tensor, box: tuple[int, int, int, int]) -> Tensor:
    args = (front.center[inside], front.conic[inside], front.opacity[inside], front.features[inside])
    if torch.is_grad_enabled():
        return checkpoint(_composite, *args, box, use_reentrant=False)
    return _composite(*args, box)


def _project(splats: Splats, cameras: Cameras, v: int, culled: dict[str, int]) -> _Footprints:
    """Culls, counts and projects. No derivative ever passes through a culled Gaussian, so no NaN can leak from it."""
    camera = OneCamera(cameras, v, splats.means)
    with torch.no_grad():
        values = [splats.means, splats.scales, splats.quats, splats.opacities[:, None], splats.colors]
        velocities = camera.velocities_of(splats)
        if velocities is not None:
            values.append(velocities)
        finite = torch.isfinite(torch.cat(values, 1)).all(1)
        turned = finite & (splats.quats.square().sum(1) >= const.QUAT_MIN_NORM2)
        posed = camera.posed(splats.means)
        exposed = camera.exposed(posed, velocities)
        ahead = turned & (posed[:, 2] >= const.NEAR_M) & (exposed[:, 2] >= const.NEAR_M)
        valid = ahead & camera.unfolded(posed) & camera.unfolded(exposed)
        culled["non_finite"] += int((~finite).sum())
        culled["quaternion"] += int((finite & ~turned).sum())
        culled["behind"] += int((turned & ~ahead).sum())
        culled["folded"] += int((ahead & ~valid).sum())
        at = torch.nonzero(valid & (splats.opacities >= const.ALPHA_MIN))[:, 0]
        center, (xx, _, yy), det, (_, posed_z), kept = _geometry(splats, camera, at)
        opacities = splats.opacities[at] * kept
        sound = (det > 0) & (torch.maximum(xx, yy) <= const.MAX_VARIANCE_PX2)
        sound &= (center.abs() <= const.MAX_CENTER_PX).all(1)
        culled["degenerate"] += int((~sound).sum())
        level = 2 * torch.log(opacities / const.ALPHA_MIN) * (1 + 1e-6)
        half = torch.sqrt(level[:, None] * torch.stack([xx, yy], 1))
        size = center.new_tensor([cameras.width_px, cameras.height_px])
        seen = sound & (opacities >= const.ALPHA_MIN) & ((center + half >= 0.5) & (center - half <= size - 0.5)).all(1)
        # Depths of one time: in each row all are seen at once, and relative to each other they barely move.
        order = torch.argsort(posed_z[seen], stable=True)
        at, half = at[seen][order], half[seen][order]
    center, (xx, xy, yy), det, (z, _), kept = _geometry(splats, camera, at)
    conic = torch.stack([yy, -xy, xx], 1) / det[:, None]
    return _Footprints(center, conic, splats.opacities[at] * kept, torch.cat([splats.colors[at], z[:, None]], 1), half)


def _geometry(
    splats: Splats, camera: OneCamera, at: Tensor
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor], Tensor, tuple[Tensor, Tensor], Tensor | float]:
    """Of the Gaussians ``at``: centres [K, 2] px, blurred covariance xx, xy, yy in px², its determinant, camera z.

    And camera z at the time of the pose, and what anti-aliasing leaves of opacities.
    """
    velocities = camera.velocities_of(splats)
    own = None if velocities is None else velocities[at]
    posed = camera.posed(splats.means[at])
    exposed, shear = camera.exposure(posed, own)
    x, y, z = exposed.unbind(1)
    jacobian = camera.jacobian(x, y, z) if shear is None else shear @ camera.jacobian(x, y, z)
    turned = jacobian @ camera.rotation @ rotation_matrices(splats.quats[at])
    m = turned * splats.scales[at][:, None, :]
    xx, yy = m.square().sum(2).unbind(1)
    xx, yy, xy = xx + const.BLUR_PX2, yy + const.BLUR_PX2, (m[:, 0] * m[:, 1]).sum(1)
    # Lagrange's identity: xx·yy − xy² cancels for long thin footprints.
    area = torch.linalg.cross(m[:, 0], m[:, 1]).square().sum(1)
    det = area + const.BLUR_PX2 * (xx + yy - const.BLUR_PX2)
    kept: Tensor | float = 1.0
    if camera.antialiased:  # clamped before the root, whose slope at 0 has no end
        kept = (area / det).clamp(min=const.COMPENSATION_MIN**2).sqrt()
    return camera.pixels(x, y, z), (xx, xy, yy), det, (z, posed[:, 2]), kept


def _composite(
    center: Tensor, conic: Tensor, opacity: Tensor, features: Tensor, box: tuple[int, int, int, int]
) -> Tensor:
    """Front to back over the pixels of a block, [h, w, 5]; every pixel × every Gaussian."""
    x0, x1, y0, y1 = box
    xs = torch.arange(x0, x1, dtype=center.dtype, device=center.device) + 0.5
    ys = torch.arange(y0, y1, dtype=center.dtype, device=center.device) + 0.5
    dx, dy = xs[:, None] - center[:, 0], ys[:, None] - center[:, 1]
    a, b, c = conic.unbind(1)
    power = (a * dx * dx)[None] / 2 + b * dx[None] * dy[:, None] + (c * dy * dy)[:, None] / 2
    raw = opacity * torch.exp(-power.clamp(min=0))
    alpha = torch.where(raw >= const.ALPHA_MIN, raw.clamp(max=const.ALPHA_MAX), torch.zeros_like(raw))
    after = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)
    weight = torch.where(after >= const.TRANSMITTANCE_STOP, alpha * before, torch.zeros_like(alpha))
    return torch.cat([weight @ features, weight.sum(-1, keepdim=True)], -1)
