"""Scores of a rollout: against the truth where it is known, and as a set against the log's real images.

They are computed as the stage ``evaluate`` computes them, so that the numbers of both compare.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.config import EvaluateConfig
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.logs.types import Truth
from genre_tasks.metrics.distribution_distances import SetDistance, frechet_distance, kernel_difference, kernel_distance
from genre_tasks.metrics.fid_lpips import FID_DIMENSIONS, Inception, fid, load_inception
from genre_tasks.metrics.lpips import Lpips, load_lpips
from genre_tasks.metrics.perceptual import POOLED_DIMENSIONS, perceptual_distance
from genre_tasks.metrics.results import Metric, ViewScore
from genre_tasks.metrics.scoring import (
    BOOTSTRAP_SEED,
    FeatureSet,
    real_image_features,
    real_inception_features,
)
from genre_tasks.metrics.view_scores import score_views
from genre_tasks.rollout.render_rollout import RolloutImages
from genre_tasks.rollout.rig import RigCamera
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_views import FixedViews, NovelView

QUALITY = ("psnr", "ssim", "perceptual")
"""Scores of single images against the truth."""


@dataclass(frozen=True)
class RolloutScores:
    """What was measured along a rollout.

    Attributes:
        metrics: ``psnr``, ``ssim``, ``perceptual`` and ``lpips…``, means over the images with a truth; ``kernel``,
            ``frechet`` and ``fid``, distances of all images to the real ones. What could not be measured is missing.
        views: scores of the images with a truth.
        features: pooled features of all images, for paired comparisons; none without distances.
    """

    metrics: tuple[Metric, ...]
    views: tuple[ViewScore, ...]
    features: FeatureSet


@dataclass(frozen=True)
class RealImages:
    """What rollouts of a log are compared with as a set.

    Attributes:
        features: pooled features of all real images.
        inception: FID's network, where the configuration names it.
        inception_features: [N, 2048] of the same images.
    """

    features: FeatureSet
    inception: Inception | None = None
    inception_features: Tensor | None = None


def collect_real_images(chunks: Sequence[Chunk], config: EvaluateConfig) -> RealImages:
    """Computes the features of all real images of a log's chunks.

    Args:
        chunks: of one log, as ``ingest`` made them.
        config: whether distances are measured, and FID's network.

    Returns:
        The reference of the rollouts' distances.

    Raises:
        InputError: an image cannot be decoded, or FID's network not be loaded.
    """
    features = _no_features()
    if config.distributions:
        sets = [real_image_features(chunk) for chunk in chunks]
        features = FeatureSet(torch.cat([s.features for s in sets]), tuple(f for s in sets for f in s.frames))
    if config.inception is None:
        return RealImages(features)
    network = load_inception(config.inception)
    return RealImages(features, network, torch.cat([real_inception_features(chunk, network) for chunk in chunks]))


def use_global_shutter(rig: Sequence[RigCamera]) -> tuple[RigCamera, ...]:
    """Takes rolling shutter and motion blur off a rig: a truth has neither, and not every method models them.

    Args:
        rig: the cameras.
    """
    return tuple(replace(camera, readout_s=0.0, exposure_s=0.0) for camera in rig)


def place_true_views(
    path: EgoPath, rig: Sequence[RigCamera], count: int, start_offset_m: float = 0.0
) -> list[NovelView]:
    """Selects views of a rollout whose truth is to be known, spread evenly over poses and cameras.

    Args:
        path: P poses. Only those at a frame of the log count, since the truth knows no moment between two.
        rig: C cameras.
        count: number of views at most.
        start_offset_m: of the rollout, metres to the left.

    Returns:
        Views in world coordinates, named by camera and frame.
    """
    views = []
    for world_SE3_ego, frame in zip(path.world_SE3_ego, path.frames, strict=True):
        # The traffic of a moment between frames is interpolated in renders, which is no truth to compare with.
        if frame == round(frame):
            for camera in rig:
                pose = world_SE3_ego @ camera.ego_SE3_camera
                name = (camera.name, int(frame))
                views.append(NovelView(*name, start_offset_m, pose, camera.lens, reference=name))
    if len(views) <= count:
        return views
    # The middles of equal parts, so that neither end of the path counts more.
    return [views[int((k + 0.5) * len(views) / count)] for k in range(count)]


def cast_true_images(truth: Truth, views: Sequence[NovelView]) -> FixedViews:
    """Ray-casts what cameras would have seen along a rollout.

    Args:
        truth: of the log.
        views: in world coordinates, as :func:`place_true_views` gives them.

    Returns:
        The images [V, H, W, 3] in [0, 1].
    """
    images = [truth.image(view.frame, view.chunk_SE3_camera, view.lens) for view in views]
    # The very floats that decoding an 8-bit image gives.
    return FixedViews(tuple(views), torch.from_numpy(np.stack(images).astype(np.float32) / np.float32(255)))


def score_rollout(
    rendered: Iterable[RolloutImages], config: EvaluateConfig, real: RealImages, true_images: FixedViews | None = None
) -> RolloutScores:
    """Scores the images of a rollout as they are rendered; no image stays in memory.

    Args:
        rendered: the images of every pose.
        config: whether distances are measured, resamples of their intervals, and LPIPS's network.
        real: the log's real images.
        true_images: the truth of some of the images, found by camera and frame.

    Returns:
        The scores.

    Raises:
        NonFiniteError: an image is not finite; the error names its camera and frame.
        InputError: a network cannot be loaded.
        ValueError: the rollout lacks an image whose truth is known.
    """
    truths = {} if true_images is None else _index_images(true_images)
    collector = _Collector(config, real, None if config.lpips is None else load_lpips(config.lpips))
    for images in rendered:
        collector.add(images, truths)
    # A truth without its image would silently make the mean one of other views.
    if len(collector.scores) != len(truths):
        raise ValueError(f"expected images of {len(truths)} views with a truth, got {len(collector.scores)}")
    return collector.summarise()


def compare_kernel_distances(
    scores: Sequence[RolloutScores], others: Sequence[RolloutScores], real: RealImages, bootstrap: int
) -> SetDistance | None:
    """Compares the kernel distances of two methods over the same rollouts of a log, paired by frames.

    Args:
        scores: of the first method.
        others: of the second one.
        real: the log's real images.
        bootstrap: number of resamples.

    Returns:
        The first distance less the second one with a 95 % interval; the first method is nearer where ``high < 0``.
    """
    first = _join_features(scores)
    second = _join_features(others)
    return kernel_difference(
        first.features,
        second.features,
        real.features.features,
        first.frames,
        second.frames,
        real.features.frames,
        bootstrap,
        seed=BOOTSTRAP_SEED,
    )


class _Collector:
    """Takes the images of one pose after the other, and keeps their scores and features."""

    def __init__(self, config: EvaluateConfig, real: RealImages, lpips: Lpips | None) -> None:
        self._config = config
        self._real = real
        self._lpips = lpips
        self._frames: list[int] = []
        self._features = [torch.zeros((0, POOLED_DIMENSIONS))]
        self._inception_features = [torch.zeros((0, FID_DIMENSIONS), dtype=torch.float64)]
        self._lpips_distances: list[float] = []
        self.scores: list[ViewScore] = []

    def add(self, images: RolloutImages, truths: Mapping[tuple[str, int], tuple[NovelView, Tensor]]) -> None:
        color = images.color.cpu().clamp(0, 1)
        for view, image in zip(images.views, color, strict=True):
            check_finite(image, "image", "rollout", camera=view.camera, frame=round(view.frame))
        if self._config.distributions:
            self._features.append(perceptual_distance().pooled_features(color))
            self._frames += [round(view.frame) for view in images.views]
        if self._real.inception is not None:
            self._inception_features.append(self._real.inception.features(color))
        # Two poses may round to one frame, but only one is exactly at it.
        known = [k for k, view in enumerate(images.views) if (view.camera, view.frame) in truths]
        if not known:
            return
        pairs = [truths[images.views[k].camera, int(images.views[k].frame)] for k in known]
        true_color = torch.stack([image for _, image in pairs])
        self.scores += score_views([view for view, _ in pairs], color[known], true_color)
        if self._lpips is not None:
            self._lpips_distances += self._lpips.distances(color[known], true_color)

    def summarise(self) -> RolloutScores:
        n = len(self.scores)
        metrics = [Metric(name, sum(getattr(s, name) for s in self.scores) / n, n) for name in QUALITY if n]
        if self._lpips is not None and self._lpips_distances:
            metrics.append(Metric(self._lpips.metric, sum(self._lpips_distances) / n, n))
        features = FeatureSet(torch.cat(self._features), tuple(self._frames))
        distances = {}
        if self._config.distributions:
            reference = self._real.features
            distances["kernel"] = kernel_distance(
                features.features,
                reference.features,
                features.frames,
                reference.frames,
                self._config.bootstrap,
                seed=BOOTSTRAP_SEED,
            )
            distances["frechet"] = frechet_distance(features.features, reference.features)
        metrics += [Metric(name, d.value, d.n, d.low, d.high) for name, d in distances.items() if d is not None]
        if self._real.inception_features is not None:
            inception_features = torch.cat(self._inception_features)
            value = fid(inception_features, self._real.inception_features)
            metrics += [] if value is None else [Metric("fid", value, len(inception_features))]
        return RolloutScores(tuple(metrics), tuple(self.scores), features)


def _index_images(true_images: FixedViews) -> dict[tuple[str, int], tuple[NovelView, Tensor]]:
    pairs = zip(true_images.views, true_images.color, strict=True)
    return {(view.camera, view.frame): (view, image) for view, image in pairs}


def _join_features(scores: Sequence[RolloutScores]) -> FeatureSet:
    features = torch.cat([s.features.features for s in scores])
    return FeatureSet(features, tuple(f for s in scores for f in s.features.frames))


def _no_features() -> FeatureSet:
    return FeatureSet(torch.zeros((0, POOLED_DIMENSIONS)), ())
