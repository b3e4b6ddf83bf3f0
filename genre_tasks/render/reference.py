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
from genre_tasks.render.reference_camera import ReferenceCamera
from genre_tasks.render.types import Cameras
from genre_tasks.scene.gaussians import Splats
from genre_tasks.scene.rotations import quats_to_matrices

BLOCK_PX = 16


@dataclass(frozen=True)
class _Footprints:
    """K projected Gaussians, front to back."""

    center: Tensor  # [K, 2] px
    conic: Tensor  # [K, 3] inverse covariance: xx, xy, yy
    opacity: Tensor  # [K]
    features: Tensor  # [K, 4] colour, camera z
    half_extent: Tensor  # [K, 2] px, of the region where alpha ≥ ALPHA_MIN


@dataclass(frozen=True)
class _Geometry:
    """K projected Gaussians, without their order and colours."""

    center: Tensor  # [K, 2] px
    covariance: tuple[Tensor, Tensor, Tensor]  # xx, xy, yy, each [K] px², blurred
    determinant: Tensor  # [K] of the covariance
    exposed_z: Tensor  # [K] metres, when the row is exposed
    posed_z: Tensor  # [K] metres, at the time of the pose
    compensation: Tensor | float  # [K] factor that anti-aliasing leaves of an opacity


def render_reference(splats: Splats, cameras: Cameras) -> tuple[tuple[Tensor, Tensor, Tensor], dict[str, int]]:
    """Renders in plain torch; differentiable in the splats, their velocities among them, and in all of the cameras.

    Args:
        splats: N of them; they give dtype and device.
        cameras: V of them.

    Returns:
        Colour [V, H, W, 3], alpha and depth [V, H, W] in the splats' dtype; and the culled counts by reason.
    """
    culled = dict.fromkeys(const.CULL_REASONS, 0)
    views = [_render_view(splats, cameras, v, culled) for v in range(len(cameras))]
    no_views = splats.means.new_zeros(0, cameras.height_px, cameras.width_px, 5)
    image = torch.stack(views) if views else no_views
    return (image[..., :3], image[..., 4], image[..., 3]), {k: n for k, n in culled.items() if n}


def _render_view(splats: Splats, cameras: Cameras, v: int, culled: dict[str, int]) -> Tensor:
    # [H, W, 5]: colour, Σ w z, alpha.
    footprints = _project(splats, cameras, v, culled)
    width = cameras.width_px
    height = cameras.height_px
    low = (footprints.center - footprints.half_extent).detach()
    high = (footprints.center + footprints.half_extent).detach()
    # Blocks, because every pixel meets every Gaussian of its block: with the whole image as one block memory would grow
    # with the number of Gaussians times that of pixels.
    bands = []
    for y in range(0, height, BLOCK_PX):
        blocks = []
        y_end = min(y + BLOCK_PX, height)
        in_band = torch.nonzero((high[:, 1] >= y + 0.5) & (low[:, 1] <= y_end - 0.5))[:, 0]
        for x in range(0, width, BLOCK_PX):
            x_end = min(x + BLOCK_PX, width)
            inside = in_band[(high[in_band, 0] >= x + 0.5) & (low[in_band, 0] <= x_end - 0.5)]
            blocks.append(_render_block(footprints, inside, (x, x_end, y, y_end)))
        bands.append(torch.cat(blocks, 1))
    return torch.cat(bands, 0)


def _render_block(footprints: _Footprints, inside: Tensor, box: tuple[int, int, int, int]) -> Tensor:
    # Recomputed in the backward pass: intermediates of all blocks together would not fit into memory.
    args = (
        footprints.center[inside],
        footprints.conic[inside],
        footprints.opacity[inside],
        footprints.features[inside],
    )
    if torch.is_grad_enabled():
        return checkpoint(_composite, *args, box, use_reentrant=False)
    return _composite(*args, box)


def _project(splats: Splats, cameras: Cameras, v: int, culled: dict[str, int]) -> _Footprints:
    # Culls, counts and projects. No derivative ever passes through a culled Gaussian, so no NaN can leak from it.
    camera = ReferenceCamera(cameras, v, splats.means)
    # First without gradient for all Gaussians, to find those that are drawn; then with gradient for these alone.
    with torch.no_grad():
        rows = _cull(splats, camera, culled)
        geometry = _project_geometry(splats, camera, rows)
        xx, _, yy = geometry.covariance
        opacities = splats.opacities[rows] * geometry.compensation
        sound = (geometry.determinant > 0) & (torch.maximum(xx, yy) <= const.MAX_VARIANCE_PX2)
        sound &= (geometry.center.abs() <= const.MAX_CENTER_PX).all(1) & torch.isfinite(geometry.exposed_z)
        culled["degenerate"] += int((~sound).sum())
        # A little wider than where alpha reaches ALPHA_MIN, so that rounding never cuts a pixel off.
        level = 2 * torch.log(opacities / const.ALPHA_MIN) * (1 + 1e-6)
        half_extent = torch.sqrt(level[:, None] * torch.stack([xx, yy], 1))
        size = geometry.center.new_tensor([cameras.width_px, cameras.height_px])
        in_image = (geometry.center + half_extent >= 0.5) & (geometry.center - half_extent <= size - 0.5)
        drawn = sound & (opacities >= const.ALPHA_MIN) & in_image.all(1)
        # Depths of one time: in each row all are seen at once, and relative to each other they barely move.
        order = torch.argsort(geometry.posed_z[drawn], stable=True)
        rows = rows[drawn][order]
        half_extent = half_extent[drawn][order]
    geometry = _project_geometry(splats, camera, rows)
    xx, xy, yy = geometry.covariance
    return _Footprints(
        center=geometry.center,
        conic=torch.stack([yy, -xy, xx], 1) / geometry.determinant[:, None],
        opacity=splats.opacities[rows] * geometry.compensation,
        features=torch.cat([splats.colors[rows], geometry.exposed_z[:, None]], 1),
        half_extent=half_extent,
    )


def _cull(splats: Splats, camera: ReferenceCamera, culled: dict[str, int]) -> Tensor:
    # Indices [K] of the Gaussians that can be projected; counts by reason what is left out.
    # The order of the checks is that of the kernel, so that each Gaussian is counted under one reason by both.
    values = [splats.means, splats.scales, splats.quats, splats.opacities[:, None], splats.colors]
    velocities = camera.relevant_velocities(splats)
    if velocities is not None:
        values.append(velocities)
    finite = torch.isfinite(torch.cat(values, 1)).all(1)
    oriented = finite & (splats.quats.square().sum(1) >= const.QUAT_MIN_NORM2)
    posed = camera.to_camera(splats.means)
    exposed = camera.move_to_exposure(posed, velocities)
    ahead = oriented & (posed[:, 2] >= const.NEAR_M) & (exposed[:, 2] >= const.NEAR_M)
    valid = ahead & camera.is_unfolded(posed) & camera.is_unfolded(exposed)
    culled["non_finite"] += int((~finite).sum())
    culled["quaternion"] += int((finite & ~oriented).sum())
    culled["behind"] += int((oriented & ~ahead).sum())
    culled["folded"] += int((ahead & ~valid).sum())
    return torch.nonzero(valid & (splats.opacities >= const.ALPHA_MIN))[:, 0]


def _project_geometry(splats: Splats, camera: ReferenceCamera, rows: Tensor) -> _Geometry:
    velocities = camera.relevant_velocities(splats)
    posed = camera.to_camera(splats.means[rows])
    exposed, shear = camera.move_to_exposure_with_shear(posed, None if velocities is None else velocities[rows])
    x, y, z = exposed.unbind(1)
    jacobian = camera.projection_jacobian(x, y, z)
    if shear is not None:
        jacobian = shear @ jacobian
    turned = jacobian @ camera.rotation @ quats_to_matrices(splats.quats[rows])
    # The 3×3 covariance is never formed: in float32 its determinant is lost for flat discs.
    m = turned * splats.scales[rows][:, None, :]
    xx, yy = m.square().sum(2).unbind(1)
    xx = xx + const.BLUR_PX2
    yy = yy + const.BLUR_PX2
    xy = (m[:, 0] * m[:, 1]).sum(1)
    # Lagrange's identity: xx·yy − xy² cancels for long thin footprints.
    area = torch.linalg.cross(m[:, 0], m[:, 1]).square().sum(1)
    determinant = area + const.BLUR_PX2 * (xx + yy - const.BLUR_PX2)
    compensation: Tensor | float = 1.0
    if camera.antialiased:  # clamped before the root, whose slope at 0 has no end
        compensation = (area / determinant).clamp(min=const.COMPENSATION_MIN**2).sqrt()
    return _Geometry(
        center=camera.to_pixels(x, y, z),
        covariance=(xx, xy, yy),
        determinant=determinant,
        exposed_z=z,
        posed_z=posed[:, 2],
        compensation=compensation,
    )


def _composite(
    center: Tensor, conic: Tensor, opacity: Tensor, features: Tensor, box: tuple[int, int, int, int]
) -> Tensor:
    # Front to back over the pixels of a block, [h, w, 5]; every pixel × every Gaussian.
    x0, x1, y0, y1 = box
    xs = torch.arange(x0, x1, dtype=center.dtype, device=center.device) + 0.5
    ys = torch.arange(y0, y1, dtype=center.dtype, device=center.device) + 0.5
    dx = xs[:, None] - center[:, 0]
    dy = ys[:, None] - center[:, 1]
    a, b, c = conic.unbind(1)
    power = (a * dx * dx)[None] / 2 + b * dx[None] * dy[:, None] + (c * dy * dy)[:, None] / 2
    raw = opacity * torch.exp(-power.clamp(min=0))
    # A clamp has gradient 0 where it clamps, as the kernel has it.
    alpha = torch.where(raw >= const.ALPHA_MIN, raw.clamp(max=const.ALPHA_MAX), torch.zeros_like(raw))
    after = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)
    # The product over all layers goes on behind the stop, but layers there have no weight: the same as ending the ray.
    weight = torch.where(after >= const.TRANSMITTANCE_STOP, alpha * before, torch.zeros_like(alpha))
    return torch.cat([weight @ features, weight.sum(-1, keepdim=True)], -1)
