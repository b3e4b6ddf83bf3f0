"""What recorded images show at the pixels of a render: the evidence that the guards of the reliable range rest on.

The fixer looks up more of each image: colours by both depths, and how far images disagree. The guards need only what
is here, so each pixel is looked up until one image sees it, and never again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from genre_tasks.fixer.view_surface import Surface, unproject_surface
from genre_tasks.fixer.warping import SourceImage, sample_source, select_sources
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Actor, Chunk
from genre_tasks.scene.novel_views import NovelView, NovelViews

# More than the margin by which a surface's points may lie outside of an actor's box.
_SPHERE_MARGIN = 1.2


@dataclass(frozen=True)
class RecordedSupport:
    """What recorded images show at a render's pixels.

    Attributes:
        shown: [H, W] true where some image sees the point at the rendered depth.
        covered: [H, W] true where some image sees the point at the LiDAR map's depth.
        colors: [3, N] sRGB of the N pixels of ``covered``, row by row, from the first image that sees each.
    """

    shown: Tensor
    covered: Tensor
    colors: Tensor


def look_up_support(chunk: Chunk, novel: NovelViews, index: int, sources: Sequence[SourceImage]) -> RecordedSupport:
    """Looks a rendered view up in recorded images, by its own depth and by the LiDAR map's.

    Images are selected and tried as for the fixer, see :func:`genre_tasks.fixer.inputs.build_inputs`.

    Args:
        chunk: the chunk, with its plan's effects applied.
        novel: rendered views with their LiDAR maps.
        index: which of them.
        sources: the chunk's recorded images.

    Returns:
        Where images support the view, and the colours that they show.

    Raises:
        ValueError: the view's reference is none of the sources.
    """
    view = novel.views[index]
    actors = select_actors_in_view(chunk.actors, view)
    pose = view.chunk_SE3_camera
    rendered = unproject_surface(novel.depth[index], novel.alpha[index], pose, view.lens, actors, view.frame)
    lidar = unproject_surface(novel.lidar_depth[index], novel.lidar_alpha[index], pose, view.lens, actors, view.frame)
    # The selection follows the LiDAR map, whose depth is free of floaters.
    selected = select_sources(lidar, sources, view.reference, actors, view.frame)
    # Both surfaces in one row of points: an image is asked once for both.
    seen, colors = _look_up_points(_join_known_points(rendered, lidar), selected, actors, view.frame)
    # Points of the render come first in the row, those of the LiDAR map after them.
    count = int(rendered.known.sum())
    seen_by_lidar = seen[count:]
    return RecordedSupport(
        shown=_scatter(seen[:count], rendered.known),
        covered=_scatter(seen_by_lidar, lidar.known),
        colors=colors[:, count:][:, seen_by_lidar],
    )


def select_actors_in_view(actors: Sequence[Actor], view: NovelView) -> list[Actor]:
    """Leaves out the actors of which no point can be in a view.

    Args:
        actors: of the chunk.
        view: whose frame and camera count.

    Returns:
        The others, in their order: those whose bounding sphere reaches into the camera's field of view.
    """
    camera_SE3_chunk = np.linalg.inv(view.chunk_SE3_camera)
    planes = _side_planes(view)
    in_view = []
    for actor in actors:
        at_frame = np.flatnonzero(actor.frames == view.frame)
        # An actor without a box at this frame has no points in it either.
        if not len(at_frame):
            continue
        center = camera_SE3_chunk @ actor.chunk_SE3_box[at_frame[0]][:, 3]
        radius = _SPHERE_MARGIN * float(np.linalg.norm(actor.size_m)) / 2
        if bool((planes @ center[:3] <= radius).all()):
            in_view.append(actor)
    return in_view


def _side_planes(view: NovelView) -> Float64:
    """Outward unit normals [P, 3] of planes through the camera, with everything in view on their inner side."""
    behind = np.array([[0.0, 0.0, -1.0]])
    lens = view.lens
    if any(lens.distortion):
        # A distorted image can show more than its focal length tells.
        return behind
    left, right = -lens.cx_px / lens.fx_px, (lens.width_px - lens.cx_px) / lens.fx_px
    top, bottom = -lens.cy_px / lens.fy_px, (lens.height_px - lens.cy_px) / lens.fy_px
    sides = np.array([[-1.0, 0.0, left], [1.0, 0.0, -right], [0.0, -1.0, top], [0.0, 1.0, -bottom]])
    return np.concatenate([behind, sides / np.linalg.norm(sides, axis=1, keepdims=True)])


def _join_known_points(*surfaces: Surface) -> Surface:
    """The known points of surfaces [H, W] one after the other, as a surface [1, N]."""
    points = torch.cat([surface.points[surface.known] for surface in surfaces])
    actor = torch.cat([surface.actor[surface.known] for surface in surfaces])
    return Surface(points[None], torch.ones(1, len(points), dtype=torch.bool), actor[None])


def _look_up_points(
    points: Surface, sources: Sequence[SourceImage], actors: Sequence[Actor], frame: int
) -> tuple[Tensor, Tensor]:
    """[N] whether any image sees a point of a surface [1, N], and the first such image's colours [3, N]."""
    count = points.known.shape[1]
    seen = torch.zeros(count, dtype=torch.bool)
    colors = torch.zeros(3, count)
    unseen = torch.arange(count)
    for source in sources:
        if not len(unseen):
            break
        # Points that an earlier image sees are settled, so each image is asked for fewer.
        remaining = Surface(points.points[:, unseen], points.known[:, unseen], points.actor[:, unseen])
        sampled, visible = sample_source(remaining, source, actors, frame)
        found = unseen[visible[0]]
        seen[found] = True
        colors[:, found] = sampled[:, visible].to(colors)
        unseen = unseen[~visible[0]]
    return seen, colors


def _scatter(values: Tensor, where: Tensor) -> Tensor:
    """[H, W] the values, row by row, where a mask is true; false elsewhere."""
    image = torch.zeros_like(where)
    image[where] = values
    return image
