"""The stage ``novel_views``: renders to the side of the path, and the LiDAR map for the fixer (paper Sec. III-B)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.config import NovelViewsConfig
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.types import DEFAULT_PLAN, EffectsPlan
from genre_tasks.image_memory import allocate_images
from genre_tasks.progress import Progress, silent
from genre_tasks.render import Render, RenderSettings, render_views
from genre_tasks.render.surface import render_surfaces
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.lidar_map import build_lidar_scene
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import NovelView, NovelViews
from genre_tasks.scene.reconstruction import Reconstruction

DEFAULT_SETTINGS = RenderSettings()


def novel_views(
    config: NovelViewsConfig,
    chunk: Chunk,
    reconstruction: Reconstruction,
    plan: EffectsPlan = DEFAULT_PLAN,
    progress: Progress = silent,
    settings: RenderSettings = DEFAULT_SETTINGS,
) -> NovelViews:
    """Renders the scene and the coloured LiDAR points at the source frames' poses, moved by each shift.

    Args:
        config: the shifts, at which source frames they are used, and how many LiDAR points are drawn.
        chunk: as ``ingest`` made it.
        reconstruction: whose scene is rendered.
        plan: of the chunk's effects.
        progress: called with the renders done and their total.
        settings: of the renderer.

    Returns:
        Views of all cameras, in the order of :func:`~genre_tasks.scene.novel_poses.place_novel_views`.

    Raises:
        NonFiniteError: an image is not finite.
    """
    # The plan gives the lenses that novel views are rendered with.
    chunk = apply_plan(chunk, plan)
    views = place_novel_views(chunk, config.shifts_m, every=config.every)
    return render_novel(chunk, reconstruction.scene, views, config.lidar_max_points, progress, settings)


def render_novel(
    chunk: Chunk,
    scene: SceneGraph,
    views: Sequence[NovelView],
    lidar_max_points: int,
    progress: Progress = silent,
    settings: RenderSettings = DEFAULT_SETTINGS,
) -> NovelViews:
    """Renders the scene and the coloured LiDAR points at any views.

    Args:
        chunk: with its plan's effects applied.
        scene: to render.
        views: all of one image size.
        lidar_max_points: points drawn in the LiDAR map.
        progress: called with the renders done and their total.
        settings: of the renderer.

    Returns:
        Images in the order of ``views``.

    Raises:
        NonFiniteError: an image is not finite.
    """
    return render_with_map(chunk, scene, build_lidar_scene(chunk, lidar_max_points), views, progress, settings)


def render_with_map(
    chunk: Chunk,
    scene: SceneGraph,
    lidar_scene: SceneGraph,
    views: Sequence[NovelView],
    progress: Progress = silent,
    settings: RenderSettings = DEFAULT_SETTINGS,
) -> NovelViews:
    """Renders the scene and a LiDAR map that is there already, for callers who render a chunk part by part.

    Args:
        chunk: that both are of, for messages.
        scene: to render.
        lidar_scene: the map, of :func:`~genre_tasks.scene.lidar_map.build_lidar_scene`.
        views: all of one image size.
        progress: called with the renders done and their total.
        settings: of the renderer.

    Returns:
        Images in the order of ``views``.

    Raises:
        NonFiniteError: an image is not finite.
    """
    # Render and map are drawn from the same poses, so that they are aligned pixel by pixel.
    image = _render(render_views, scene, views, settings, progress, 0, "novel views")
    lidar = _render(render_surfaces, lidar_scene, views, settings, progress, len(views), "LiDAR maps")
    progress(2 * len(views), 2 * len(views), "novel views")
    images = NovelViews(
        views=tuple(views),
        color=image.color,
        alpha=image.alpha,
        depth=image.depth,
        lidar_color=lidar.color,
        lidar_alpha=lidar.alpha,
        lidar_depth=lidar.depth,
        culled=image.culled,
        lidar_culled=lidar.culled,
    )
    # A single NaN pixel would spread over the image in the fixer's convolutions.
    for name in ("color", "alpha", "depth", "lidar_color", "lidar_alpha", "lidar_depth"):
        check_finite(getattr(images, name), name, "novel_views", log=chunk.log, chunk=chunk.index)
    return images


@dataclass(frozen=True)
class _Images:
    """Renders of all views, with depths that are not premultiplied."""

    color: Tensor
    alpha: Tensor
    depth: Tensor
    culled: dict[str, int]


def _render(
    render: Callable[[SceneGraph, Sequence[NovelView], RenderSettings], Render],
    scene: SceneGraph,
    views: Sequence[NovelView],
    settings: RenderSettings,
    progress: Progress,
    done: int,
    note: str,
) -> _Images:
    """Renders the views of each frame in one call, so that progress moves between frames."""
    tensors: tuple[Tensor, ...] = ()
    # Counts of Gaussians that were left out are added up, for the report.
    culled: Counter[str] = Counter()
    start = 0
    with torch.no_grad():
        while start < len(views):
            end = start + 1
            while end < len(views) and views[end].frame == views[start].frame:
                end += 1
            progress(done + start, 2 * len(views), note)
            part = render(scene, views[start:end], settings)
            images = (part.color, part.alpha, part.expected_depth())
            # Filled in place: joining the parts at the end would need the memory twice.
            tensors = tensors or tuple(
                allocate_images(len(views), *image.shape[1:], device=image.device) for image in images
            )
            for tensor, image in zip(tensors, images, strict=True):
                tensor[start:end] = image
            culled.update(part.culled)
            start = end
    color, alpha, depth = tensors
    return _Images(color, alpha, depth, dict(culled))
