"""Novel views beside the path: renders of a scene, and the LiDAR map that conditions the fixer (paper Sec. III-B)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import torch

from genre_tasks.config import NovelViewsConfig
from genre_tasks.effects.apply_plan import applied
from genre_tasks.effects.types import UNPLANNED, EffectsPlan
from genre_tasks.errors import NonFiniteError
from genre_tasks.progress import Progress, silent
from genre_tasks.render import Render, RenderSettings, render_views
from genre_tasks.render.surface import render_surfaces
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.lidar_map import lidar_scene
from genre_tasks.scene.novel_poses import novel_view_poses
from genre_tasks.scene.novel_views import NovelView, NovelViews
from genre_tasks.scene.reconstruction import Reconstruction

DEFAULT_SETTINGS = RenderSettings()


def novel_views(
    config: NovelViewsConfig,
    chunk: Chunk,
    reconstruction: Reconstruction,
    plan: EffectsPlan = UNPLANNED,
    progress: Progress = silent,
    settings: RenderSettings = DEFAULT_SETTINGS,
) -> NovelViews:
    """Renders the scene and the coloured LiDAR points at the source frames' poses, moved by each shift.

    All cameras, in the order of ``novel_view_poses``. Raises ``NonFiniteError`` if an image is not finite.
    """
    chunk = applied(chunk, plan)
    views = novel_view_poses(chunk, config.shifts_m)
    return render_novel(chunk, reconstruction.scene, views, config.lidar_max_points, progress, settings)


def render_novel(
    chunk: Chunk,
    scene: SceneGraph,
    views: Sequence[NovelView],
    lidar_max_points: int,
    progress: Progress = silent,
    settings: RenderSettings = DEFAULT_SETTINGS,
) -> NovelViews:
    """As :func:`novel_views`, at any ``views``."""
    image = _render(render_views, scene, views, settings, progress, 0, "novel views")
    points = lidar_scene(chunk, lidar_max_points)
    lidar = _render(render_surfaces, points, views, settings, progress, len(views), "LiDAR maps")
    progress(2 * len(views), 2 * len(views), "novel views")
    images = NovelViews(
        tuple(views),
        image.color,
        image.alpha,
        image.expected_depth(),
        lidar.color,
        lidar.alpha,
        lidar.expected_depth(),
        image.culled,
        lidar.culled,
    )
    for name in ("color", "alpha", "depth", "lidar_color", "lidar_alpha", "lidar_depth"):
        bad = (~getattr(images, name).isfinite()).nonzero()
        if len(bad):
            index = tuple(int(i) for i in bad[0])
            raise NonFiniteError("novel_views", name, len(bad), index, log=chunk.log, chunk=chunk.index)
    return images


def _render(
    draw: Callable[[SceneGraph, Sequence[NovelView], RenderSettings], Render],
    scene: SceneGraph,
    views: Sequence[NovelView],
    settings: RenderSettings,
    progress: Progress,
    done: int,
    note: str,
) -> Render:
    """A call for each run of views of one frame, so that progress moves."""
    parts = []
    start = 0
    with torch.no_grad():
        while start < len(views):
            end = start + 1
            while end < len(views) and views[end].frame == views[start].frame:
                end += 1
            progress(done + start, 2 * len(views), note)
            parts.append(draw(scene, views[start:end], settings))
            start = end
    color, alpha, depth = (torch.cat([getattr(p, name) for p in parts]) for name in ("color", "alpha", "depth"))
    culled: Counter[str] = Counter()
    for part in parts:
        culled.update(part.culled)
    return Render(color, alpha, depth, dict(culled))
