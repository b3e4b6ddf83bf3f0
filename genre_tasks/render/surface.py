"""Renders whose depth is that of the surfaces that flat Gaussians lie on, rather than of their centres.

A splat has one depth, its centre's. On a road seen at a grazing angle a pixel is metres away from the centres of the
discs that cover it, and blending does not cure it: nearer discs come first, so depths are biased towards the camera.
The planes through discs of one surface, though, blend exactly: the point of a plane n · x = c along the ray r is at
1/z = (n/c) · r, which is linear in n/c.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from genre_tasks.logs.types import Lens
from genre_tasks.render.api import DEFAULT, cameras_of, moving, on_device_of, render, render_views
from genre_tasks.render.motion_blur import PosedView
from genre_tasks.render.reference_camera import OneCamera
from genre_tasks.render.types import Render, RenderSettings
from genre_tasks.scene.gaussians import Splats
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.lens_distortion import rays_at

MIN_COSINE = 0.01
"""Between a ray and a disc's normal: a disc seen more on edge counts as facing the camera."""

MOST_APART = 0.2
"""Where a plane's depth is farther than this share from the blended depth, planes do not meet: the latter stays."""


@torch.no_grad()
def render_surfaces(scene: SceneGraph, views: Sequence[PosedView], settings: RenderSettings = DEFAULT) -> Render:
    """As :func:`render_views`, with ``depth`` such that ``expected_depth`` is where rays meet the planes of the discs.

    A Gaussian's plane is across its shortest axis. Raises as :func:`render_views`.
    """
    plain = render_views(scene, views, settings)
    centre = plain.expected_depth()
    depth = torch.empty_like(plain.depth)
    posed: dict[float, tuple[Splats, Tensor]] = {}
    for k, view in enumerate(views):
        if view.frame not in posed:
            splats = scene.at(view.frame).activated()
            posed = {view.frame: (splats, normals(splats))}
        splats, across = posed[view.frame]
        splats = moving(splats, scene, view)
        camera = on_device_of(cameras_of([view], scene.antialiased), splats.means)
        planes = replace(splats, colors=_planes(splats, across, view, OneCamera(camera, 0, splats.means)))
        image = render(planes, camera, settings)
        inverse = (image.color[0] * _rays(view.lens, image.color)).sum(-1) / image.alpha[0].clamp_min(1e-6)
        plane = 1 / inverse.clamp_min(1e-6)
        meets = (inverse > 0) & ((plane - centre[k]).abs() <= MOST_APART * centre[k])
        depth[k] = torch.where(meets, plane, centre[k]) * plain.alpha[k]
    return replace(plain, depth=depth)


def normals(splats: Splats) -> Tensor:
    """Unit vectors [N, 3] along each Gaussian's shortest axis; zero for a quaternion without direction."""
    shortest = torch.nn.functional.one_hot(splats.scales.argmin(1), 3).to(splats.quats)
    unit = splats.quats / splats.quats.norm(dim=1, keepdim=True).clamp_min(1e-20)
    w, axis = unit[:, :1], unit[:, 1:]
    turned = 2 * torch.linalg.cross(axis, shortest)
    return shortest + w * turned + torch.linalg.cross(axis, turned)


def _planes(splats: Splats, across: Tensor, view: PosedView, camera: OneCamera) -> Tensor:
    """n/c of each Gaussian's plane n · x = c in the camera's frame when its row is exposed, [N, 3]."""
    pose = torch.as_tensor(view.chunk_SE3_camera).to(splats.means)
    posed, n = (splats.means - pose[:3, 3]) @ pose[:3, :3], across @ pose[:3, :3]
    at = camera.exposed(posed, splats.velocities)
    c = (n * at).sum(1, keepdim=True)
    facing = torch.zeros_like(at)
    facing[:, 2] = 1 / at[:, 2].clamp_min(1e-3)
    edge_on = c.abs() <= MIN_COSINE * at.norm(dim=1, keepdim=True)
    return torch.where(edge_on, facing, n / torch.where(edge_on, torch.ones_like(c), c))


def _rays(lens: Lens, like: Tensor) -> Tensor:
    """[H, W, 3] through pixel centres, z = 1."""
    v, u = torch.meshgrid(torch.arange(lens.height_px) + 0.5, torch.arange(lens.width_px) + 0.5, indexing="ij")
    x, y = (u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px
    if any(lens.distortion):
        x, y = (torch.from_numpy(w) for w in rays_at(u.double().numpy(), v.double().numpy(), lens))
    return torch.stack([x, y, torch.ones_like(x)], -1).to(like)
