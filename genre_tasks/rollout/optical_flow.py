"""How far the pixels of a rollout move from one pose to the next: by surfaces, actors' boxes and both poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.logs.brown_conrady import distort
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.render.surface import render_surfaces
from genre_tasks.render.types import RenderSettings
from genre_tasks.rollout.instance_masks import MIN_ALPHA, render_masks
from genre_tasks.rollout.render_rollout import DEFAULT_SETTINGS, RolloutImages
from genre_tasks.rollout.rig import RolloutView
from genre_tasks.scene.lens_distortion import fold_radius, pixels_to_rays
from genre_tasks.scene.transforms import invert_se3

HIDDEN_FRACTION = 0.1
HIDDEN_M = 0.3
"""A point is hidden in the next image where that shows a surface nearer than the point by more than both together."""

_NEAR_M = 0.1


def compute_flow(
    images: RolloutImages, next_images: RolloutImages, settings: RenderSettings = DEFAULT_SETTINGS
) -> Tensor:
    """Computes optical flow from one pose to the next.

    A pixel's point lies on its surface and moves with its actor's box, or rests. With a rolling shutter, what a camera
    moves within the readout counts for the next image alone as much as for this one, and is left out of both.

    Args:
        images: of a pose.
        next_images: of the next one, with the same cameras; its chunk may be another one.
        settings: backend and threads.

    Returns:
        [C, H, W, 2] pixels to the right and down; NaN where nothing is, where the point is hidden in the next image or
        behind its camera, and where its actor does not exist there. What leaves the image has its flow.
    """
    # All without the readout: masks and surfaces that differ by it would move background with an actor.
    images = _stop_cameras(images)
    next_images = _stop_cameras(next_images)
    masks = render_masks(images, settings)
    depth, covered = _render_depth(images, settings)
    next_depth, _ = _render_depth(next_images, settings)
    flows = []
    for c, (view, next_view) in enumerate(zip(images.views, next_images.views, strict=True)):
        points = _unproject(view, depth[c].numpy())
        moved = _move_points(points, masks.instances[c].numpy(), images, next_images, view, next_view)
        target, target_depth = _project(moved, next_view)
        flow = target - _pixel_centers(view.lens)
        hidden = _find_hidden(target, target_depth, next_depth[c].numpy())
        flow[hidden | ~covered[c].numpy()] = np.nan
        flows.append(torch.from_numpy(flow.astype(np.float32)))
    return torch.stack(flows)


def _stop_cameras(images: RolloutImages) -> RolloutImages:
    """The images with cameras that rest at their poses: neither a rolling shutter nor motion blur."""
    return replace(images, views=tuple(replace(view, blur=None, shutter=None) for view in images.views))


def _render_depth(images: RolloutImages, settings: RenderSettings) -> tuple[Tensor, Tensor]:
    """[C, H, W] metres along the cameras' axes, and where there is a surface."""
    surfaces = render_surfaces(images.chunk_scene.scene, images.views, settings)
    return surfaces.expected_depth(), surfaces.alpha >= MIN_ALPHA


def _pixel_centers(lens: Lens) -> Float64:
    v, u = np.meshgrid(np.arange(lens.height_px) + 0.5, np.arange(lens.width_px) + 0.5, indexing="ij")
    return np.stack([u, v], -1)


def _unproject(view: RolloutView, depth: NDArray[np.float32]) -> Float64:
    """[H, W, 3] metres in chunk coordinates."""
    centers = _pixel_centers(view.lens)
    x: Float64 = (centers[..., 0] - view.lens.cx_px) / view.lens.fx_px
    y: Float64 = (centers[..., 1] - view.lens.cy_px) / view.lens.fy_px
    if any(view.lens.distortion):
        x, y = pixels_to_rays(centers[..., 0], centers[..., 1], view.lens)
    points = np.stack([x, y, np.ones_like(x)], -1) * depth[..., None].astype(np.float64)
    return _apply(view.chunk_SE3_camera, points)


def _move_points(
    points: Float64,
    instances: NDArray[np.int32],
    images: RolloutImages,
    next_images: RolloutImages,
    view: RolloutView,
    next_view: RolloutView,
) -> Float64:
    """Points [H, W, 3] where they are at the next pose, in coordinates of its chunk; NaN where their actor is gone."""
    before = images.chunk_scene
    after = next_images.chunk_scene
    # Through the world: consecutive poses may be of two chunks, with coordinates of their own.
    next_SE3_chunk = invert_se3(after.chunk.world_SE3_chunk) @ before.chunk.world_SE3_chunk
    moved = _apply(next_SE3_chunk, points)
    next_actors = {actor.track_id: actor for actor in after.scene.actors}
    for instance in np.unique(instances[instances > 0]):
        actor = before.scene.actors[instance - 1]
        box = actor.pose(view.frame)
        next_actor = next_actors.get(actor.track_id)
        next_box = None if next_actor is None else next_actor.pose(next_view.frame)
        chosen = instances == instance
        if box is None or next_box is None:
            moved[chosen] = np.nan
        else:
            moved[chosen] = _apply(next_box @ invert_se3(box), points[chosen])
    return moved


def _project(points: Float64, view: RolloutView) -> tuple[Float64, Float64]:
    """Pixels [H, W, 2] and depths [H, W] in a view; NaN behind the camera and where the lens folds back."""
    lens = view.lens
    posed = _apply(invert_se3(view.chunk_SE3_camera), points)
    depth = posed[..., 2].copy()
    with np.errstate(invalid="ignore"):
        depth[~(depth > _NEAR_M)] = np.nan
        x = posed[..., 0] / depth
        y = posed[..., 1] / depth
    if any(lens.distortion):
        with np.errstate(invalid="ignore"):
            depth[x * x + y * y >= fold_radius(lens.coefficients) ** 2] = np.nan
        x, y = (np.asarray(bent, np.float64) for bent in distort(x, y, lens.coefficients))
        x[np.isnan(depth)] = np.nan
    return np.stack([x * lens.fx_px + lens.cx_px, y * lens.fy_px + lens.cy_px], -1), depth


def _find_hidden(target: Float64, target_depth: Float64, next_depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Where points lie behind the surface that the next image shows there, or have no place in it."""
    height, width = next_depth.shape
    nowhere = np.isnan(target_depth)
    column = np.floor(np.where(nowhere, -1.0, target[..., 0]))
    row = np.floor(np.where(nowhere, -1.0, target[..., 1]))
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    shown = np.zeros_like(target_depth)
    shown[inside] = next_depth[row[inside].astype(np.int64), column[inside].astype(np.int64)]
    with np.errstate(invalid="ignore"):
        behind = target_depth > shown * (1 + HIDDEN_FRACTION) + HIDDEN_M
    # Without a surface nothing hides the point.
    return np.asarray(nowhere | (inside & (shown > 0) & behind))


def _apply(pose: Float64, points: Float64) -> Float64:
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])
