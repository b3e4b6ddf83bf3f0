"""What the scene of an effect's benchmark is evaluated by; more is better in all of them.

Each is called with the chunk as its plan shows it, a scene, and the log's truth if it has one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from benchmarks.common.scores import pooled_psnr
from genre_tasks.effects.anti_aliasing import footprint_ratios
from genre_tasks.effects.nonrigid_actors import mask_deformable_actors
from genre_tasks.logs.types import Float32, Truth
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.metrics.scoring import decode_view_image, truth_image
from genre_tasks.render.api import render_views
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.lidar_depth import compute_lidar_depth
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.visibility import find_visible_points
from genre_tasks.stages.evaluation_renders import apply_view_gains

SceneMeasure = Callable[[Chunk, SceneGraph, Truth | None], float]

SIDE_M = 3.0
FOOTPRINT_RATIO = 2.0
"""A point counts as seen from far and near where its footprints in the views are more than this factor apart."""


def heldout_psnr(chunk: Chunk, scene: SceneGraph, _truth: Truth | None = None) -> float:
    """Averages the PSNR of held-out views as the cameras recorded them, outside of the recording vehicle.

    Args:
        chunk: as its plan shows it.
        scene: what to render.

    Returns:
        dB.
    """
    return _mean_psnr(scene, chunk.views_with_role("heldout"))


def masked_cameras_psnr(chunk: Chunk, scene: SceneGraph, _truth: Truth | None = None) -> float:
    """Averages as :func:`heldout_psnr`, over the cameras that have the recording vehicle in their images.

    The other cameras' images hardly depend on its mask, and would hide what the mask is worth.

    Args:
        chunk: as its plan shows it.
        scene: what to render.

    Returns:
        dB; over all cameras where the vehicle is in no image.
    """
    masked = {v.camera for v in chunk.views if v.ego_mask is not None}
    return _mean_psnr(scene, [v for v in chunk.views_with_role("heldout") if not masked or v.camera in masked])


def _mean_psnr(scene: SceneGraph, views: Sequence[View]) -> float:
    values = []
    for view in views:
        # The vehicle is fitted by nobody, so its pixels would only add a constant error.
        outside = None if view.ego_mask is None else ~view.ego_mask
        values.append(psnr(_render_as_recorded(scene, view), decode_view_image(view).numpy(), outside))
    return float(np.mean(values))


def _render_as_recorded(scene: SceneGraph, view: View) -> Float32:
    """Renders a recorded view with its exposure: [H, W, 3] in [0, 1]."""
    with torch.no_grad():
        image: Float32 = apply_view_gains(render_views(scene, [view]).color, [view]).clamp(0, 1)[0].numpy()
    return image


def heldout_people_psnr(chunk: Chunk, scene: SceneGraph, _truth: Truth | None = None) -> float:
    """Computes the PSNR over all pixels of held-out views that boxes of pedestrians and cyclists cover.

    They are a few per cent of the pixels, so that the PSNR of whole images hardly depends on them.

    Args:
        chunk: as its plan shows it.
        scene: what to render.

    Returns:
        dB; :func:`heldout_psnr` where nobody is in the views.
    """
    error = 0.0
    count = 0
    for view in chunk.views_with_role("heldout"):
        # Errors are pooled over pixels and not averaged by view: a view with three pixels of people would dominate.
        people = mask_deformable_actors(chunk, view)
        difference = _render_as_recorded(scene, view) - decode_view_image(view).numpy()
        error += float(np.square(difference).mean(-1)[people].sum(dtype=np.float64))
        count += int(people.sum())
    return pooled_psnr(error, count) if count else heldout_psnr(chunk, scene)


def heldout_depth_score(chunk: Chunk, scene: SceneGraph, _truth: Truth | None = None) -> float:
    """Compares rendered depth with the LiDAR returns of held-out frames.

    Args:
        chunk: as its plan shows it.
        scene: what to render.

    Returns:
        Minus the median relative error, per cent.
    """
    errors = []
    for view in chunk.views_with_role("heldout"):
        with torch.no_grad():
            depth = render_views(scene, [view]).expected_depth()[0]
        lidar = compute_lidar_depth(chunk, view)
        # Zero stands for no return and for nothing rendered.
        known = (lidar > 0) & (depth > 0)
        errors.append((depth[known] / lidar[known] - 1).abs())
    # The median, because a ray at an edge may hit the wrong surface by many metres.
    return -100 * float(torch.cat(errors).median())


def novel_view_psnr(chunk: Chunk, scene: SceneGraph, truth: Truth | None) -> float:
    """Averages the PSNR at ±3 m against what an ideal camera would have recorded.

    Args:
        chunk: as its plan shows it.
        scene: what to render.
        truth: of the log.

    Returns:
        dB; :func:`heldout_psnr` where there is no truth.
    """
    if truth is None:
        return heldout_psnr(chunk, scene)
    return _ideal_psnr(chunk, scene, truth, place_novel_views(chunk, (SIDE_M, -SIDE_M)))


def sharp_psnr(chunk: Chunk, scene: SceneGraph, truth: Truth | None) -> float:
    """Averages as :func:`novel_view_psnr`, where held-out frames were taken."""
    if truth is None:
        return heldout_psnr(chunk, scene)
    frames = sorted({v.frame for v in chunk.views_with_role("heldout")})
    return _ideal_psnr(chunk, scene, truth, place_novel_views(chunk, (0.0,), frames))


def _ideal_psnr(chunk: Chunk, scene: SceneGraph, truth: Truth, views: Sequence[NovelView]) -> float:
    values = []
    for view in views:
        with torch.no_grad():
            image = render_views(scene, [view]).color.clamp(0, 1)[0]
        values.append(psnr(image.numpy(), _true_image(chunk, truth, view)))
    return float(np.mean(values))


def _true_image(chunk: Chunk, truth: Truth, view: NovelView) -> Float32:
    image: Float32 = truth_image(chunk, truth, view).astype(np.float32) / np.float32(255)
    return image


def footprint_change_psnr(chunk: Chunk, scene: SceneGraph, truth: Truth | None) -> float:
    """Computes the PSNR at ±3 m over pixels that show a point which the source views see from far and from near.

    Args:
        chunk: as its plan shows it.
        scene: what to render.
        truth: of the log; held-out frames stand in for it where there is none.

    Returns:
        dB; NaN where no such point is visible.
    """
    if truth is None:
        recorded = [(v, decode_view_image(v).numpy()) for v in chunk.views_with_role("heldout")]
        return psnr_where_footprints_change(chunk, scene, recorded)
    ideal = []
    for v in place_novel_views(chunk, (SIDE_M, -SIDE_M)):
        # The masks and projections below take recorded views, so a novel one is dressed as such.
        view = View(v.camera, v.frame, "heldout", 0.0, v.chunk_SE3_camera, v.lens, b"")
        ideal.append((view, _true_image(chunk, truth, v)))
    return psnr_where_footprints_change(chunk, scene, ideal)


def psnr_where_footprints_change(chunk: Chunk, scene: SceneGraph, views: Sequence[tuple[View, Float32]]) -> float:
    """Computes the PSNR over pixels of LiDAR returns that the views see from far and from near.

    Args:
        chunk: its static returns are projected into the views.
        scene: what to render.
        views: with their true images, [H, W, 3] in [0, 1].

    Returns:
        dB, outside of the recording vehicle; NaN where no such return is visible.
    """
    # Points of no sweep, such as completed surfaces, need not be where any view could see them.
    points = chunk.static.positions[chunk.static.frames >= 0]
    # Where all footprints are alike, smoothing brings nothing, and those pixels would hide the effect.
    changing = footprint_ratios(chunk, points) > FOOTPRINT_RATIO
    error = 0.0
    count = 0
    for view, true in views:
        index, uv, _ = find_visible_points(points, view)
        u, v = uv[changing[index]].astype(np.int64).T
        if view.ego_mask is not None:
            outside = ~view.ego_mask[v, u]
            u = u[outside]
            v = v[outside]
        image = _render_as_recorded(scene, view)
        error += float(np.square(image[v, u] - true[v, u]).mean(-1).sum(dtype=np.float64))
        count += len(u)
    return pooled_psnr(error, count) if count else math.nan
