"""What the recorded path sees of a scene's Gaussians: how much of the images each one fills, and in which colour.

A viewer without spherical harmonics shows one colour for each Gaussian, and a page has room for so many Gaussians.
Both follow from the weight of a Gaussian in an image, the sum of its opacity times the transmittance before it over all
pixels. It is the slope of the image's sum in the Gaussian's colour, which the renderer's backward pass gives exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from flows.viewer.path_drawing import list_image_frames
from genre_tasks.logs.types import Float32
from genre_tasks.progress import Progress, silent
from genre_tasks.render.api import build_cameras, compute_view_colors, render
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import NovelView

SHIFTS_M = (0.0, -3.0, 3.0)
"""Beside the path other Gaussians come into view, which someone who looks about wants to see."""

_MAX_WIDTH_PX = 320
_MAX_VIEWS = 96


@dataclass(frozen=True)
class PathColors:
    """What views see of N Gaussians.

    Attributes:
        weights: [N] pixels that a Gaussian fills, by its opacity and what hides it, summed over the views.
        colors: [N, 3] sRGB in [0, 1], the mean over the views with these weights.
    """

    weights: Float32
    colors: Float32


def measure_path_colors(
    scene: SceneGraph, chunk: Chunk, shifts_m: Sequence[float] = SHIFTS_M, progress: Progress = silent
) -> PathColors:
    """Measures what the cameras of a chunk see of its scene, on the path and beside it.

    Args:
        scene: N Gaussians.
        chunk: with its cameras.
        shifts_m: metres to the left that views are placed at.
        progress: called for each view.

    Returns:
        Weights and colours. A Gaussian that no view shows has weight 0 and the colour that the first view would see.

    Raises:
        ValueError: the chunk has no images.
    """
    views = _select_views(chunk, shifts_m)
    if not views:
        raise ValueError("expected a chunk with views, got one without")
    base = scene.gaussians.colors.detach()
    weights = torch.zeros(len(scene))
    weighted = torch.zeros(len(scene), 3)
    unseen = _view_colors(scene, views[0])
    for k, view in enumerate(views):
        weight = _measure_weights(scene, view)
        weights += weight
        # Without spherical harmonics all views see one colour, which needs no mean.
        if scene.spherical_harmonics is not None:
            weighted += weight[:, None] * _view_colors(scene, view)
        progress(k + 1, len(views), "views of the path")
    colors = base
    if scene.spherical_harmonics is not None:
        visible = weights > 0
        colors = torch.where(visible[:, None], weighted / weights.clamp_min(1e-12)[:, None], unseen)
    return PathColors(_to_numpy(weights), np.clip(_to_numpy(colors), 0.0, 1.0))


def _select_views(chunk: Chunk, shifts_m: Sequence[float]) -> tuple[NovelView, ...]:
    per_frame = max(1, len(chunk.camera_names) * len(shifts_m))
    # Cameras may be slower than the log's frames, and a frame without an image has no view.
    frames = list_image_frames(chunk)
    count = min(len(frames), max(2, _MAX_VIEWS // per_frame))
    rows = np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))
    views = place_novel_views(chunk, shifts_m, frames=[frames[row] for row in rows])
    # Small images tell the same weights, in a fraction of the time.
    return tuple(replace(v, lens=v.lens.resized_to_width(min(v.lens.width_px, _MAX_WIDTH_PX))) for v in views)


def _measure_weights(scene: SceneGraph, view: NovelView) -> Tensor:
    splats = scene.gaussians_at(view.frame).activate()
    splats = replace(splats, **{name: getattr(splats, name).detach() for name in ("means", "scales", "quats")})
    colors = torch.zeros(len(splats), 3, requires_grad=True)
    image = render(replace(splats, colors=colors), build_cameras([view], scene.antialiased)).color
    # One channel is enough: a Gaussian has the same weight in all of them.
    (gradient,) = torch.autograd.grad(image[..., 0].sum(), colors)
    return gradient[:, 0].nan_to_num()


def _view_colors(scene: SceneGraph, view: NovelView) -> Tensor:
    if scene.spherical_harmonics is None:
        return scene.gaussians.colors.detach()
    with torch.no_grad():
        colors = compute_view_colors(scene, [view])[0]
    moves = scene.nodes >= FIRST_ACTOR if scene.actors else torch.zeros_like(scene.nodes, dtype=torch.bool)
    # Stable: the colours are those of what rests and then of what moves, both in the order of the scene.
    order = torch.argsort(moves.to(torch.uint8), stable=True)
    out = torch.empty_like(colors)
    out[order] = colors
    return out.nan_to_num()


def _to_numpy(values: Tensor) -> Float32:
    return np.asarray(values.detach().cpu().float().numpy())
