"""The stage ``evaluate``: held-out frames, lateral shifts, distances between sets of images (paper Sec. IV-B).

Held-out frames have real images. To the side of the path a truth exists only where the log can be ray-cast; elsewhere
the renders are compared, as a set, with all real images of the chunk.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from genre_tasks.config import EvaluateConfig
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.types import DEFAULT_PLAN, EffectsPlan
from genre_tasks.logs.types import Truth
from genre_tasks.metrics.fid_lpips import load_inception
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.metrics.lpips import load_lpips
from genre_tasks.metrics.results import Evaluation, Metric, ViewScore
from genre_tasks.metrics.scoring import ScoreCollector, decode_view_image, real_image_features, truth_image
from genre_tasks.progress import Progress, silent
from genre_tasks.render.types import RenderSettings
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import FixedViews, NovelView, NovelViews
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.evaluation_pictures import render_pictures, select_fixed_pictures
from genre_tasks.stages.evaluation_renders import ImageProgress, render_batches, split_into_batches

CURVE_VIEWS = 12
"""The curve of accuracy is taken on at most so many held-out views, spread evenly over the chunk's."""

_DEFAULT_SETTINGS = RenderSettings()


def evaluate_scene(
    config: EvaluateConfig,
    chunk: Chunk,
    stage: str,
    reconstruction: Reconstruction,
    truth: Truth | None,
    plan: EffectsPlan = DEFAULT_PLAN,
    progress: Progress = silent,
    settings: RenderSettings = _DEFAULT_SETTINGS,
) -> Evaluation:
    """Measures what the scene of a stage looks like on the path and to the side of it.

    ``interpolation/…`` compares held-out views with their images, ``shift_0m/…`` the same renders as a set with all
    real images. ``shift_Xm/…`` looks at both sides of every ``config.every``-th frame. ``…/fid`` and ``…/lpips…``
    are there where the configuration names their networks.

    Args:
        config: what is measured.
        chunk: as ``ingest`` made it.
        stage: that made the scene: initial, gnet or enet.
        reconstruction: the scene and its snapshots.
        truth: of the log, where it can be ray-cast.
        plan: of the chunk's effects.
        progress: called with the images done and their total.
        settings: of the renderer.

    Returns:
        Metrics, scores of single views, the PSNR of snapshots and final scene on ``CURVE_VIEWS`` held-out views, and
        pictures.

    Raises:
        InputError: an image of the chunk cannot be decoded.
        NonFiniteError: a render is not finite.
    """
    chunk = apply_plan(chunk, plan)
    scene = reconstruction.scene
    heldout = chunk.views_with_role("heldout")
    views_at_shift = {shift: _place_shifted_views(config, chunk, shift) for shift in _measurable_shifts(config, truth)}
    # The final scene is a point of the curve even where no snapshot was taken.
    scenes = dict(reconstruction.snapshots) | {_final_iteration(reconstruction): scene}
    curve_views = [heldout[i] for i in _spread_evenly(len(heldout), CURVE_VIEWS)]
    shifted_count = sum(len(views) for views in views_at_shift.values())
    counter = ImageProgress(progress, len(heldout) + shifted_count + len(scenes) * len(curve_views), stage)

    collector = _new_collector(config, stage, recorded=True)
    for batch, images in render_batches(scene, heldout, settings, counter):
        collector.add(batch, images, torch.stack([decode_view_image(view) for view in batch]))
    metrics, scores = _collect(config, chunk, "interpolation", "shift_0m", [collector])
    for shift, views in views_at_shift.items():
        collector = _new_collector(config, stage)
        for novel_batch, images in render_batches(scene, views, settings, counter):
            collector.add(novel_batch, images, _truth_images(chunk, truth, novel_batch))
        group = f"shift_{shift:g}m"
        more_metrics, more_scores = _collect(config, chunk, group, group, [collector])
        metrics += more_metrics
        scores += more_scores
    curve = tuple(
        (iteration, _mean_psnr(snapshot, curve_views, settings, counter))
        for iteration, snapshot in sorted(scenes.items())
        if curve_views
    )
    pictures = render_pictures(config, chunk, scene, truth, settings)
    return Evaluation(stage, tuple(metrics), tuple(scores), curve, pictures)


def evaluate_fixed(
    config: EvaluateConfig,
    chunk: Chunk,
    fixed: FixedViews,
    novel: NovelViews,
    truth: Truth | None,
    progress: Progress = silent,
) -> Evaluation:
    """Measures the fixer's images of the novel views, and for comparison the renders that it fixed.

    ``shift_3m/psnr`` and others are of the fixed images, ``shift_3m/render_psnr`` of the renders. Both are of the same
    views. Their set is that of the source frames; the set of :func:`evaluate_scene` may be larger.

    Args:
        config: what is measured.
        chunk: that the views are of.
        fixed: the fixer's images.
        novel: the renders of the same views, in the same order.
        truth: of the log, where it can be ray-cast.
        progress: called with the images done and their total.

    Returns:
        Metrics, scores of single views, and pictures.

    Raises:
        NonFiniteError: an image is not finite.
        ValueError: the two do not show the same views.
    """
    # The comparison of fixed and rendered is view by view, and would be meaningless otherwise.
    if _view_keys(fixed.views) != _view_keys(novel.views):
        raise ValueError("expected the fixed images of the novel views, in their order; got those of other views")
    indices_at_shift: dict[float, list[int]] = {}
    for index, view in enumerate(fixed.views):
        indices_at_shift.setdefault(abs(view.shift_m), []).append(index)
    counter = ImageProgress(progress, len(fixed.views), "fnet")
    metrics: list[Metric] = []
    scores: list[ViewScore] = []
    for shift, indices in sorted(indices_at_shift.items()):
        fixed_collector = _new_collector(config, "fnet")
        render_collector = _new_collector(config, "fnet", "render_")
        for batch in split_into_batches(indices, chunk.width_px, chunk.height_px):
            views = [fixed.views[i] for i in batch]
            truths = _truth_images(chunk, truth, views)
            fixed_collector.add(views, fixed.color[batch].cpu().clamp(0, 1), truths)
            # Renders are scored on the same views and at equal N: kernel and Fréchet distances depend on the number of
            # images.
            render_collector.add(views, novel.color[batch].cpu().clamp(0, 1), truths)
            counter.add(len(batch))
        group = f"shift_{shift:g}m"
        more_metrics, more_scores = _collect(config, chunk, group, group, [fixed_collector, render_collector])
        metrics += more_metrics
        scores += more_scores
    pictures = select_fixed_pictures(config, chunk, fixed, truth)
    return Evaluation("fnet", tuple(metrics), tuple(scores), (), pictures)


def _view_keys(views: Sequence[NovelView]) -> list[tuple[str, int, float]]:
    return [(view.camera, view.frame, view.shift_m) for view in views]


def _new_collector(config: EvaluateConfig, stage: str, prefix: str = "", recorded: bool = False) -> ScoreCollector:
    """Raises ``InputError`` for a network that cannot be loaded."""
    return ScoreCollector(
        stage,
        config.distributions,
        prefix,
        recorded,
        inception=None if config.inception is None else load_inception(config.inception),
        lpips=None if config.lpips is None else load_lpips(config.lpips),
    )


def _place_shifted_views(config: EvaluateConfig, chunk: Chunk, shift_m: float) -> tuple[NovelView, ...]:
    # Of frames that have images: cameras may be slower than frames, and images be lost.
    frames = sorted({view.frame for view in chunk.views})[:: config.every]
    return place_novel_views(chunk, (shift_m, -shift_m), frames)


def _measurable_shifts(config: EvaluateConfig, truth: Truth | None) -> list[float]:
    """Distinct lateral shifts, if anything can be measured there."""
    # Without a truth and without distances between sets, renders at a shift would be compared with nothing.
    if truth is None and not config.distributions and config.inception is None:
        return []
    # Both sides are always rendered, so that +3 and −3 are one shift.
    return sorted({abs(shift) for shift in config.shifts_m if shift != 0})


def _collect(
    config: EvaluateConfig,
    chunk: Chunk,
    quality_group: str,
    distance_group: str,
    collectors: Sequence[ScoreCollector],
) -> tuple[list[Metric], list[ViewScore]]:
    """All metrics of the collectors under the two group names, and the first one's scores of single images."""
    metrics = [m for collector in collectors for m in collector.quality_metrics(quality_group)]
    if config.distributions:
        real = real_image_features(chunk)
        for collector in collectors:
            metrics += collector.distribution_metrics(distance_group, real, config.bootstrap)
    metrics += [m for collector in collectors for m in collector.fid_metrics(distance_group, chunk)]
    return metrics, list(collectors[0].scores)


def _final_iteration(reconstruction: Reconstruction) -> int:
    """How many iterations made the final scene."""
    return len(reconstruction.losses) or max(reconstruction.snapshots, default=0)


def _spread_evenly(count: int, max_count: int) -> list[int]:
    """At most ``max_count`` indices below ``count``, each in the middle of an equal part."""
    # The middles of equal parts, so that neither end of the chunk counts more.
    part = max(count, 1) / min(max(count, 1), max_count)
    return [int((k + 0.5) * part) for k in range(min(count, max_count))]


def _truth_images(chunk: Chunk, truth: Truth | None, views: Sequence[NovelView]) -> Tensor | None:
    """[V, H, W, 3] in [0, 1], or ``None`` where the log cannot tell."""
    if truth is None:
        return None
    images = [truth_image(chunk, truth, view).astype(np.float32) / 255 for view in views]
    return torch.stack([torch.from_numpy(image) for image in images])


def _mean_psnr(scene: SceneGraph, views: Sequence[View], settings: RenderSettings, progress: ImageProgress) -> float:
    """Mean over views of the PSNR against their images, the recording vehicle itself left out."""
    values = []
    for batch, images in render_batches(scene, views, settings, progress):
        for view, image in zip(batch, images, strict=True):
            # The vehicle itself is neither an error of the scene nor its merit.
            outside_ego = None if view.ego_mask is None else ~view.ego_mask
            values.append(psnr(image.numpy(), decode_view_image(view).numpy(), outside_ego))
    return sum(values) / len(values)
