"""What removed actors hid: which of a view's pixels show background that no recorded image shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.fixer.view_surface import Surface, unproject_surface
from genre_tasks.fixer.warping import SourceImage, sample_source
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.rollout.moment_actors import THIS_MOMENT, pose_actors
from genre_tasks.rollout.render_rollout import RolloutImages
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.lens_distortion import pixels_to_rays
from genre_tasks.scene.transforms import invert_se3

# Boxes are drawn tight; mirrors and wheels stick out, and LiDAR and cameras do not fire at one moment.
BOX_MARGIN = 1.1
"""Boxes of removed actors are enlarged by this factor."""


def find_filled_area(
    images: RolloutImages, depth: Tensor, sources: Sequence[SourceImage], recorded: Sequence[ActorNode]
) -> Tensor:
    """Finds the pixels where a removed actor stood before background that no recorded image shows.

    Args:
        images: of one pose; their scene says which actors were removed.
        depth: [C, H, W] metres to the background, 0 where unknown. LiDAR knows a road that no image shows, and the
            render does not: it looks through thin Gaussians there.
        sources: all recorded images of the chunk, see :func:`hide_behind_boxes`.
        recorded: actors of the chunk as the log has them.

    Returns:
        [C, H, W] true where the ray of a pixel meets the box of a removed actor, and the point that the pixel shows
        behind or below it is in no image.
    """
    removed = images.chunk_scene.removed
    area = torch.zeros_like(images.alpha, dtype=torch.bool)
    if not removed:
        return area
    frames = sorted({source.frame for source in sources})
    actors = images.chunk_scene.scene.actors
    by_track = {actor.track_id: actor for actor in recorded}
    for k, view in enumerate(images.views):
        entry = measure_depth_to_boxes(view.chunk_SE3_camera, view.lens, removed, view.frame).to(images.depth)
        posed = pose_actors(actors, {THIS_MOMENT: view.frame}, by_track, frames)
        known = (depth[k] > 0).to(depth)
        surface = unproject_surface(depth[k], known, view.chunk_SE3_camera, view.lens, posed, THIS_MOMENT)
        # What is nearer than the box was never hidden by it.
        candidates = torch.isfinite(entry) & (~surface.known | (depth[k] > entry))
        if not bool(candidates.any()):
            continue
        # Few pixels are candidates, so that all images can be asked about them.
        points = Surface(*(t[candidates][None] for t in (surface.points, surface.known, surface.actor)))
        visible = torch.zeros_like(points.known)
        for source in sources:
            visible |= sample_source(points, source, posed, THIS_MOMENT)[1]
        area[k, candidates] = ~visible[0]
    return area


def hide_behind_boxes(sources: Sequence[SourceImage], removed: Sequence[ActorNode]) -> tuple[SourceImage, ...]:
    """Puts the boxes of removed actors into the depth of recorded images, which then show nothing behind them.

    LiDAR alone leaves gaps between its rings, through which an actor's pixels would pass for the background's.

    Args:
        sources: recorded images.
        removed: actors as recorded, in the same coordinates.

    Returns:
        The images in their order, with depths that end at the boxes.
    """
    out = []
    for source in sources:
        entry = measure_depth_to_boxes(source.chunk_SE3_camera, source.lens, removed, source.frame).to(source.depth)
        nearest = torch.where(source.depth > 0, torch.minimum(source.depth, entry), entry)
        out.append(replace(source, depth=torch.where(torch.isfinite(entry), nearest, source.depth)))
    return tuple(out)


def measure_depth_to_boxes(
    chunk_SE3_camera: Float64, lens: Lens, actors: Sequence[ActorNode], frame: float
) -> Tensor:
    """Measures how far the boxes of actors are along the ray of each pixel.

    Args:
        chunk_SE3_camera: [4, 4].
        lens: of the camera.
        actors: whose boxes, enlarged by ``BOX_MARGIN``.
        frame: log frame, or a moment between two, at which the actors are posed.

    Returns:
        [H, W] float64 metres along the camera's axis to the nearest box; infinite where a ray meets none.
    """
    u, v = np.meshgrid(np.arange(lens.width_px) + 0.5, np.arange(lens.height_px) + 0.5)
    x, y = pixels_to_rays(u, v, lens)
    rays = np.stack([x, y, np.ones_like(x)], -1)
    nearest = np.full(x.shape, np.inf)
    for actor in actors:
        chunk_SE3_box = actor.pose(frame)
        if chunk_SE3_box is None:
            continue
        box_SE3_camera = invert_se3(chunk_SE3_box) @ chunk_SE3_camera
        directions = rays @ box_SE3_camera[:3, :3].T
        # A ray that is parallel to a face would divide by zero.
        directions = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        half_size = BOX_MARGIN * np.asarray(actor.size_m) / 2
        to_faces = np.stack([(side * half_size - box_SE3_camera[:3, 3]) / directions for side in (-1, 1)])
        entry = to_faces.min(0).max(-1)
        leave = to_faces.max(0).min(-1)
        # A camera inside of the box is behind its front face.
        met = (entry <= leave) & (leave > 0)
        nearest = np.where(met, np.minimum(nearest, np.maximum(entry, 0.0)), nearest)
    return torch.from_numpy(nearest)
