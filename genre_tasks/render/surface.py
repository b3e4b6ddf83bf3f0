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
from genre_tasks.render.api import DEFAULT_SETTINGS, build_cameras, render, render_views, with_shutter_velocities
from genre_tasks.render.motion_blur import PosedView
from genre_tasks.render.reference_camera import ReferenceCamera
from genre_tasks.render.types import Render, RenderSettings
from genre_tasks.scene.gaussians import Splats
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.lens_distortion import pixels_to_rays
from genre_tasks.scene.rotations import rotate_vectors

MIN_COSINE = 0.01
"""Between a ray and a disc's normal: a disc seen more on edge counts as facing the camera."""

MAX_RELATIVE_DIFFERENCE = 0.2
"""Where a plane's depth is farther than this fraction from the blended depth, planes do not meet: the latter stays."""


@torch.no_grad()
def render_surfaces(
    scene: SceneGraph, views: Sequence[PosedView], settings: RenderSettings = DEFAULT_SETTINGS
) -> Render:
    """Renders views with depths of surfaces, as the fixer needs them to look source images up; without gradient.

    A Gaussian's surface is the plane across its shortest axis.

    Args:
        scene: mostly of flat Gaussians.
        views: of one image size.
        settings: backend and threads.

    Returns:
        As :func:`render_views`, with ``depth`` such that ``expected_depth`` is where rays meet the planes.

    Raises:
        ValueError, NonFiniteError, ResourceError, ConfigError: as :func:`render_views`.
    """
    # The ordinary render decides on alpha and colour, and on the depth where planes do not meet.
    blended = render_views(scene, views, settings)
    blended_depth = blended.expected_depth()
    depth = torch.empty_like(blended.depth)
    splats_at: dict[float, tuple[Splats, Tensor]] = {}
    for k, view in enumerate(views):
        if view.frame not in splats_at:
            # The last frame only: views come frame by frame, and all frames' splats would fill the memory.
            splats = scene.gaussians_at(view.frame).activate()
            splats_at = {view.frame: (splats, compute_normals(splats))}
        splats, normals = splats_at[view.frame]
        splats = with_shutter_velocities(splats, scene, view)
        camera = build_cameras([view], scene.antialiased).to_device_of(splats.means)
        planes = _planes(splats, normals, view, ReferenceCamera(camera, 0, splats.means))
        # The renderer blends any three numbers a Gaussian, so it blends n/c in place of a colour.
        image = render(replace(splats, colors=planes), camera, settings)
        inverse = (image.color[0] * _rays(view.lens, image.color)).sum(-1) / image.alpha[0].clamp_min(1e-6)
        # Behind the camera or parallel to the ray there is no point; the limit keeps the quotient finite until it is
        # left out below.
        plane_depth = 1 / inverse.clamp_min(1e-6)
        close = (plane_depth - blended_depth[k]).abs() <= MAX_RELATIVE_DIFFERENCE * blended_depth[k]
        depth[k] = torch.where((inverse > 0) & close, plane_depth, blended_depth[k]) * blended.alpha[k]
    return replace(blended, depth=depth)


def compute_normals(splats: Splats) -> Tensor:
    """Computes the normals of the discs that flat Gaussians are.

    Args:
        splats: N of them.

    Returns:
        Unit vectors [N, 3] along each Gaussian's shortest axis.

    >>> scales = torch.tensor([[1.0, 1.0, 0.1]])
    >>> disc = Splats(torch.zeros(1, 3), scales, torch.eye(4)[:1], torch.ones(1), torch.ones(1, 3))
    >>> compute_normals(disc).tolist()
    [[0.0, 0.0, 1.0]]
    """
    shortest = torch.nn.functional.one_hot(splats.scales.argmin(1), 3).to(splats.quats)
    return rotate_vectors(splats.quats, shortest)


def _planes(splats: Splats, normals: Tensor, view: PosedView, camera: ReferenceCamera) -> Tensor:
    # n/c [N, 3] of each Gaussian's plane n · x = c in the camera's frame when its row is exposed.
    pose = torch.as_tensor(view.chunk_SE3_camera).to(splats.means)
    posed = (splats.means - pose[:3, 3]) @ pose[:3, :3]
    n = normals @ pose[:3, :3]
    exposed = camera.move_to_exposure(posed, splats.velocities)
    c = (n * exposed).sum(1, keepdim=True)
    facing = torch.zeros_like(exposed)
    facing[:, 2] = 1 / exposed[:, 2].clamp_min(1e-3)
    # A plane through the camera has no depth: such a disc counts as facing the camera, at its centre.
    edge_on = c.abs() <= MIN_COSINE * exposed.norm(dim=1, keepdim=True)
    return torch.where(edge_on, facing, n / torch.where(edge_on, torch.ones_like(c), c))


def _rays(lens: Lens, like: Tensor) -> Tensor:
    # [H, W, 3] through pixel centres, z = 1.
    v, u = torch.meshgrid(torch.arange(lens.height_px) + 0.5, torch.arange(lens.width_px) + 0.5, indexing="ij")
    x = (u - lens.cx_px) / lens.fx_px
    y = (v - lens.cy_px) / lens.fy_px
    if any(lens.distortion):
        x, y = (torch.from_numpy(w) for w in pixels_to_rays(u.double().numpy(), v.double().numpy(), lens))
    return torch.stack([x, y, torch.ones_like(x)], -1).to(like)
