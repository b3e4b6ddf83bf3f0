"""Evaluation after a stage: held-out frames, lateral shifts, distances between sets (paper Sec. IV-B).

Held-out frames have real images; beside the path the truth exists only where the log can be ray-cast, elsewhere the
renders are compared, as a set, with all real images of the chunk.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.config import EvaluateConfig
from genre_tasks.effects.apply_plan import applied
from genre_tasks.effects.types import UNPLANNED, EffectsPlan
from genre_tasks.logs.types import Truth
from genre_tasks.metrics.fid_lpips import inception, lpips
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.metrics.results import Evaluation, Metric, ViewScore
from genre_tasks.metrics.scoring import Collector, real_images, true_pixels, view_image
from genre_tasks.progress import Progress, silent
from genre_tasks.render import render_views
from genre_tasks.render.types import RenderSettings
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_poses import novel_view_poses
from genre_tasks.scene.novel_views import FixedViews, NovelView, NovelViews
from genre_tasks.scene.reconstruction import Reconstruction

CURVE_VIEWS = 12
"""The curve of accuracy is taken on at most so many held-out views, spread evenly over the chunk's."""

PICTURE_SHIFT_M = 3.0
"""Pictures beside the path are taken where the fixer works, at ±3 m."""

_BATCH_PIXELS = 2**20
_AUTO = RenderSettings()
AnyView = TypeVar("AnyView", bound=View | NovelView)


def evaluate_scene(
    config: EvaluateConfig,
    chunk: Chunk,
    stage: str,
    reconstruction: Reconstruction,
    truth: Truth | None,
    plan: EffectsPlan = UNPLANNED,
    progress: Progress = silent,
    settings: RenderSettings = _AUTO,
) -> Evaluation:
    """What the scene of ``stage`` (initial, gnet, enet) looks like on the path and beside it.

    ``interpolation/…``: held-out views against their images. ``shift_0m/…``: the same renders as a set against all real
    images. ``shift_Xm/…``: both sides, every ``config.every``-th frame. Colours are clamped to [0, 1]; what no Gaussian
    covers is black. ``…/fid`` and ``…/lpips`` are there where the configuration names their networks.
    The curve gives the PSNR of the snapshots and the final scene on ``CURVE_VIEWS`` held-out views.

    Raises:
        InputError: an image of the chunk cannot be decoded. NonFiniteError: a render is not finite.
    """
    chunk = applied(chunk, plan)
    heldout = chunk.of_role("heldout")
    shifts = _shifts(config, truth)
    frames = chunk.frames[:: config.every]
    beside = {shift: novel_view_poses(chunk, (shift, -shift), frames) for shift in shifts}
    scenes = dict(reconstruction.snapshots) | {_iterations(reconstruction): reconstruction.scene}
    subset = [heldout[i] for i in _spread(len(heldout), CURVE_VIEWS)]
    steps = _Steps(progress, len(heldout) + sum(map(len, beside.values())) + len(scenes) * len(subset), stage)

    collector = _collector(config, stage)
    for views, images in _rendered(reconstruction.scene, heldout, settings, steps):
        collector.add(views, images, torch.stack([view_image(v) for v in views]))
    metrics, scores = _collected(config, chunk, "interpolation", "shift_0m", [collector])
    for shift, poses in beside.items():
        collector = _collector(config, stage)
        for novel, images in _rendered(reconstruction.scene, poses, settings, steps):
            collector.add(novel, images, _true_images(chunk, truth, novel))
        group = f"shift_{shift:g}m"
        more = _collected(config, chunk, group, group, [collector])
        metrics, scores = metrics + more[0], scores + more[1]
    curve = tuple(
        (iteration, _mean_psnr(scene, subset, settings, steps)) for iteration, scene in sorted(scenes.items()) if subset
    )
    pictures = _scene_pictures(config, chunk, reconstruction.scene, truth, settings)
    return Evaluation(stage, tuple(metrics), tuple(scores), curve, pictures)


def evaluate_fixed(
    config: EvaluateConfig,
    chunk: Chunk,
    fixed: FixedViews,
    novel: NovelViews,
    truth: Truth | None,
    progress: Progress = silent,
) -> Evaluation:
    """The fixer's images of the novel views: ``shift_3m/psnr`` …, and ``shift_3m/render_psnr`` … of what it was given.

    Both are of the same views, at equal N. Their set is the source frames', that of ``evaluate_scene`` may be larger.

    Raises:
        NonFiniteError: an image is not finite. ValueError: the two do not show the same views.
    """
    keys, given = ([(v.camera, v.frame, v.shift_m) for v in x.views] for x in (fixed, novel))
    if keys != given:
        raise ValueError("expected the fixed images of the novel views, in their order; got those of other views")
    groups: dict[float, list[int]] = {}
    for index, view in enumerate(fixed.views):
        groups.setdefault(abs(view.shift_m), []).append(index)
    steps = _Steps(progress, len(fixed.views), "fnet")
    metrics: list[Metric] = []
    scores: list[ViewScore] = []
    for shift, indices in sorted(groups.items()):
        repaired, rendered = (_collector(config, "fnet", prefix) for prefix in ("", "render_"))
        for batch in _batches(indices, chunk):
            views = [fixed.views[i] for i in batch]
            true = _true_images(chunk, truth, views)
            for collector, images in ((repaired, fixed.color), (rendered, novel.color)):
                collector.add(views, images[batch].cpu().clamp(0, 1), true)
            steps.add(len(batch))
        group = f"shift_{shift:g}m"
        more = _collected(config, chunk, group, group, [repaired, rendered])
        metrics, scores = metrics + more[0], scores + more[1]
    return Evaluation("fnet", tuple(metrics), tuple(scores), (), _fixed_pictures(config, chunk, fixed, truth))


class _Steps:
    """Counts images for the progress callback."""

    def __init__(self, progress: Progress, total: int, stage: str) -> None:
        self._progress, self._total, self._note, self._done = progress, total, f"evaluating {stage}", 0
        self.add(0)

    def add(self, count: int) -> None:
        self._done += count
        self._progress(self._done, self._total, self._note)


def _collector(config: EvaluateConfig, stage: str, prefix: str = "") -> Collector:
    """Raises ``InputError`` for a network that cannot be loaded."""
    networks = (
        None if config.inception is None else inception(config.inception),
        None if config.lpips is None else lpips(config.lpips),
    )
    return Collector(stage, config.distributions, prefix, *networks)


def _shifts(config: EvaluateConfig, truth: Truth | None) -> list[float]:
    """Distinct lateral shifts, if anything can be measured there."""
    if truth is None and not config.distributions and config.inception is None:
        return []
    return sorted({abs(s) for s in config.shifts_m if s != 0})


def _collected(
    config: EvaluateConfig, chunk: Chunk, quality: str, distances: str, collectors: Sequence[Collector]
) -> tuple[list[Metric], list[ViewScore]]:
    """All metrics of the collectors under the two group names, and the first one's scores of single images."""
    metrics = [m for c in collectors for m in c.quality(quality)]
    if config.distributions:
        real = real_images(chunk)
        metrics += [m for c in collectors for m in c.distances(distances, real, config.bootstrap)]
    metrics += [m for c in collectors for m in c.inception_distance(distances, chunk)]
    return metrics, collectors[0].scores


def _iterations(reconstruction: Reconstruction) -> int:
    """How many iterations made the final scene."""
    return len(reconstruction.losses) or max(reconstruction.snapshots, default=0)


def _spread(count: int, most: int) -> list[int]:
    """At most ``most`` indices, evenly spread over ``count``; the middle of each share."""
    share = max(count, 1) / min(max(count, 1), most)
    return [int((k + 0.5) * share) for k in range(min(count, most))]


def _batches(items: Sequence[int], chunk: Chunk) -> Iterator[list[int]]:
    size = max(1, _BATCH_PIXELS // (chunk.width_px * chunk.height_px))
    for start in range(0, len(items), size):
        yield list(items[start : start + size])


def _rendered(
    scene: SceneGraph, views: Sequence[AnyView], settings: RenderSettings, steps: _Steps | None
) -> Iterator[tuple[list[AnyView], Tensor]]:
    """Batches of views with their images [B, H, W, 3], clamped to [0, 1], on the CPU."""
    if not views:
        return
    lens = views[0].lens
    size = max(1, _BATCH_PIXELS // (lens.width_px * lens.height_px))
    for start in range(0, len(views), size):
        batch = list(views[start : start + size])
        with torch.no_grad():
            color = as_recorded(render_views(scene, batch, settings).color.cpu(), batch)
        yield batch, color.clamp(0, 1)
        if steps is not None:
            steps.add(len(batch))


def as_recorded(color: Tensor, views: Sequence[View | NovelView]) -> Tensor:
    """Renders [V, H, W, 3] as the cameras would have recorded them: with each view's gain, where it has one."""
    gains = {k: v.log_gain for k, v in enumerate(views) if isinstance(v, View) and v.log_gain is not None}
    if not gains:
        return color
    from genre_tasks.effects.exposure import toned

    color = color.clone()
    for k, gain in gains.items():
        color[k] = toned(color[k], color.new_tensor(gain))
    return color


def _true_images(chunk: Chunk, truth: Truth | None, views: Sequence[NovelView]) -> Tensor | None:
    """[V, H, W, 3] in [0, 1], or ``None`` where the log cannot tell."""
    if truth is None:
        return None
    return torch.stack([torch.from_numpy(true_pixels(chunk, truth, v).astype(np.float32) / 255) for v in views])


def _mean_psnr(scene: SceneGraph, views: Sequence[View], settings: RenderSettings, steps: _Steps) -> float:
    values = [
        psnr(image.numpy(), view_image(view).numpy(), None if view.own is None else ~view.own)
        for batch, images in _rendered(scene, views, settings, steps)
        for view, image in zip(batch, images, strict=True)
    ]
    return sum(values) / len(values)


def _scene_pictures(
    config: EvaluateConfig, chunk: Chunk, scene: SceneGraph, truth: Truth | None, settings: RenderSettings
) -> dict[str, NDArray[np.uint8]]:
    """Renders at the report's viewpoints, and what is known of the truth there."""
    pictures = {}
    for view in _picture_views(config, chunk):
        name = _picture_name(view)
        ((_, images),) = _rendered(scene, [view], settings, None)
        pictures[name] = _to_uint8(images[0])
        if isinstance(view, View):
            pictures[f"{name}.truth"] = _to_uint8(view_image(view))
        elif truth is not None:
            pictures[f"{name}.truth"] = true_pixels(chunk, truth, view)
    return pictures


def _fixed_pictures(
    config: EvaluateConfig, chunk: Chunk, fixed: FixedViews, truth: Truth | None
) -> dict[str, NDArray[np.uint8]]:
    """The fixer's images at the report's viewpoints beside the path, as far as it was given them."""
    at = {(v.camera, v.frame, v.shift_m): i for i, v in enumerate(fixed.views)}
    pictures = {}
    for view in _picture_views(config, chunk):
        if isinstance(view, NovelView) and (view.camera, view.frame, view.shift_m) in at:
            name = _picture_name(view)
            pictures[name] = _to_uint8(fixed.color[at[view.camera, view.frame, view.shift_m]])
            if truth is not None:
                pictures[f"{name}.truth"] = true_pixels(chunk, truth, view)
    return pictures


def _picture_views(config: EvaluateConfig, chunk: Chunk) -> list[View | NovelView]:
    """The report's viewpoints, the same for every stage: per camera, forward ones first, a held-out view and both
    sides of the source frame in the middle of the chunk."""
    frames = sorted({v.frame for v in chunk.of_role("source")})
    if not frames:
        return []
    middle = frames[len(frames) // 2]
    novel = novel_view_poses(chunk, (PICTURE_SHIFT_M, -PICTURE_SHIFT_M), [middle])
    out: list[View | NovelView] = []
    for camera in sorted(chunk.camera_names, key=lambda name: ("front" not in name, len(name))):
        heldout = [v for v in chunk.of_role("heldout") if v.camera == camera]
        out += sorted(heldout, key=lambda v: abs(v.frame - middle))[:1]
        out += [v for v in novel if v.camera == camera]
    return out[: config.pictures]


def _picture_name(view: View | NovelView) -> str:
    if isinstance(view, View):
        return f"0m_{view.camera}_{view.frame:02d}"
    side = "left" if view.shift_m > 0 else "right"
    return f"{abs(view.shift_m):g}m_{side}_{view.camera}_{view.frame:02d}"


def _to_uint8(image: Tensor) -> NDArray[np.uint8]:
    return (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
