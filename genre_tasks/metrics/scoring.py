"""Metrics of a set of images: each against its truth where there is one, and all of them against the real images."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.logs.types import Truth
from genre_tasks.metrics.distribution_distances import frechet_distance, kernel_distance
from genre_tasks.metrics.fid_lpips import Inception, fid
from genre_tasks.metrics.lpips import Lpips
from genre_tasks.metrics.perceptual import POOLED_DIMENSIONS, perceptual_distance
from genre_tasks.metrics.results import Metric, ViewScore
from genre_tasks.metrics.view_scores import fitted_psnr, score_views, show_truth_on_ego
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.image_decoding import decode_image
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.threads import map_single_threaded

BOOTSTRAP_SEED = 0
"""The resamples over frames are the same for every stage and method, so that their intervals can be compared."""

_BATCH = 16
"""Real images decoded at once: they are large, their features are small."""
_CACHED_CHUNKS = 4
_CACHED_TRUTH_BYTES = 2**28


@dataclass(frozen=True)
class FeatureSet:
    """Pooled features of N images with the frame of each.

    Attributes:
        features: [N, 1280].
        frames: the N log frames.
    """

    features: Tensor
    frames: tuple[int, ...]


_real_features: OrderedDict[str, FeatureSet] = OrderedDict()
_real_inception_features: dict[tuple[str, Inception], Tensor] = {}
_truth_images: OrderedDict[tuple[object, ...], tuple[Truth, NDArray[np.uint8]]] = OrderedDict()


def real_image_features(chunk: Chunk) -> FeatureSet:
    """Computes the features of all real images of a chunk, the reference of the distribution distances.

    They are computed once per process and chunk, by content, and kept for the last chunks.

    Args:
        chunk: its recorded images are taken at the working resolution.

    Raises:
        InputError: an image cannot be decoded.
    """
    key = _digest_images(chunk)
    if key not in _real_features:
        parts = [torch.zeros((0, POOLED_DIMENSIONS))]
        parts += [perceptual_distance().pooled_features(images) for images in _decode_batches(chunk)]
        _real_features[key] = FeatureSet(torch.cat(parts), tuple(view.frame for view in chunk.views))
        if len(_real_features) > _CACHED_CHUNKS:
            _real_features.popitem(last=False)
    _real_features.move_to_end(key)
    return _real_features[key]


def real_inception_features(chunk: Chunk, network: Inception) -> Tensor:
    """Computes FID's features of all real images of a chunk; kept for the last chunk.

    Args:
        chunk: its recorded images are taken at the working resolution.
        network: FID's network.

    Returns:
        [N, 2048] float64.

    Raises:
        InputError: an image cannot be decoded.
    """
    key = _digest_images(chunk), network
    if key not in _real_inception_features:
        parts = [network.features(images) for images in _decode_batches(chunk)]
        # Only the last chunk: FID of one chunk is asked for stage after stage.
        _real_inception_features.clear()
        _real_inception_features[key] = torch.cat(parts)
    return _real_inception_features[key]


def decode_view_image(view: View) -> Tensor:
    """Decodes a recorded image at the working resolution.

    Args:
        view: a view of a chunk.

    Returns:
        [H, W, 3] sRGB in [0, 1].

    Raises:
        InputError: the image cannot be decoded.
    """
    return decode_image(view.image, view.lens.width_px, view.lens.height_px)


def truth_image(chunk: Chunk, truth: Truth, view: NovelView) -> NDArray[np.uint8]:
    """Asks a log's truth what the camera would have seen; the last images are kept, as every stage asks for the same.

    Args:
        chunk: the chunk whose coordinates the view's pose is in.
        truth: of the chunk's log.
        view: a view beside the path.

    Returns:
        [H, W, 3] sRGB.
    """
    # The truth knows the world, not the chunk.
    pose = chunk.world_SE3_chunk @ view.chunk_SE3_camera
    # The entry keeps the truth alive, so that no other object can get its id while the entry is there.
    key = (id(truth), view.frame, pose.tobytes(), view.lens)
    if key not in _truth_images:
        _truth_images[key] = truth, truth.image(view.frame, pose, view.lens)
        while len(_truth_images) > 1 and sum(x.nbytes for _, x in _truth_images.values()) > _CACHED_TRUTH_BYTES:
            _truth_images.popitem(last=False)
    # Last used goes last, so that the oldest image is dropped first.
    _truth_images.move_to_end(key)
    return _truth_images[key][1]


@dataclass
class ScoreCollector:
    """Takes images batch by batch, and keeps their scores and features instead of the images.

    Attributes:
        stage: the stage that errors name.
        distributions: whether features for the distribution distances are computed.
        recorded: whether the views are of the log: then colours are fitted, too, for exposures that scenes cannot know.
        prefix: goes before a metric's last word: ``render_`` makes ``shift_3m/render_psnr``.
        inception: the network for FID proper, where the user gave it.
        lpips: the network for LPIPS proper, where the user named it.
        scores: of the images with a truth, in the order in which they came.
    """

    stage: str
    distributions: bool
    prefix: str = ""
    recorded: bool = False
    inception: Inception | None = None
    lpips: Lpips | None = None
    scores: list[ViewScore] = field(default_factory=list)
    _features: list[Tensor] = field(default_factory=list)
    _frames: list[int] = field(default_factory=list)
    _inception_features: list[Tensor] = field(default_factory=list)
    _lpips: list[float] = field(default_factory=list)
    _cc_psnr: list[float] = field(default_factory=list)

    def add(
        self,
        views: Sequence[View | NovelView],  # V
        images: Tensor,  # [V, H, W, 3] sRGB in [0, 1]
        truths: Tensor | None,  # [V, H, W, 3]
    ) -> None:
        """Scores a batch of images.

        Args:
            views: where the images are from.
            images: the images to judge.
            truths: what they should show; ``None``: only their distribution counts.

        Raises:
            NonFiniteError: an image is not finite; the error names its camera and frame.
        """
        for view, image in zip(views, images, strict=True):
            # One by one, so that the error can name camera and frame.
            check_finite(image, "image", f"evaluate/{self.stage}", camera=view.camera, frame=view.frame)
        if self.distributions:
            # Features instead of images: those of all views would not fit into memory.
            self._features.append(perceptual_distance().pooled_features(images))
            # Frames go with the features: the bootstrap resamples them.
            self._frames += [view.frame for view in views]
        if self.inception is not None:
            self._inception_features.append(self.inception.features(images))
        if truths is not None:
            self.scores += score_views(views, images, truths)
            if self.recorded:
                self._cc_psnr += fitted_psnr(views, images, truths)
            if self.lpips is not None:
                self._lpips += self.lpips.distances(show_truth_on_ego(views, images, truths), truths)

    def quality_metrics(self, group: str) -> list[Metric]:
        """Averages the scores over the images with truth.

        Args:
            group: first part of the metrics' names.

        Returns:
            ``group/psnr``, ``group/ssim``, ``group/perceptual``, ``group/cc_psnr`` of recorded views, and
            ``group/lpips…`` where its network is named; nothing without images that have a truth.
        """
        n = len(self.scores)
        metrics = []
        for name in ("psnr", "ssim", "perceptual") if n else ():
            # Every image counts alike, whatever its camera.
            metrics.append(Metric(self._name(group, name), sum(getattr(s, name) for s in self.scores) / n, n))
        if self._cc_psnr:
            metrics.append(Metric(self._name(group, "cc_psnr"), sum(self._cc_psnr) / n, n))
        if self.lpips is not None and self._lpips:
            metrics.append(Metric(self._name(group, self.lpips.metric), sum(self._lpips) / n, n))
        return metrics

    def fid_metrics(self, group: str, chunk: Chunk) -> list[Metric]:
        """Compares all images with the real images of a chunk by FID.

        Args:
            group: first part of the metric's name.
            chunk: its recorded images are the reference.

        Returns:
            ``group/fid``; nothing without FID's network or with fewer than two images.
        """
        if self.inception is None or not self._inception_features:
            return []
        features = torch.cat(self._inception_features)
        # Against the real images of the chunk, as the other distances are.
        value = fid(features, real_inception_features(chunk, self.inception))
        return [] if value is None else [Metric(self._name(group, "fid"), value, len(features))]

    def distribution_metrics(self, group: str, real: FeatureSet, bootstrap: int) -> list[Metric]:
        """Compares all images with real ones by the Fréchet and the kernel distance.

        Args:
            group: first part of the metrics' names.
            real: features of the real images.
            bootstrap: resamples for the interval of the kernel distance.

        Returns:
            ``group/frechet`` and ``group/kernel``; nothing where they are undefined (fewer than two images).
        """
        if not self._features:
            return []
        features = torch.cat(self._features)
        distances = {
            "frechet": frechet_distance(features, real.features),
            "kernel": kernel_distance(
                features, real.features, self._frames, real.frames, bootstrap, seed=BOOTSTRAP_SEED
            ),
        }
        return [
            Metric(self._name(group, name), d.value, d.n, d.low, d.high)
            for name, d in distances.items()
            if d is not None
        ]

    def _name(self, group: str, metric: str) -> str:
        return f"{group}/{self.prefix}{metric}"


def _decode_batches(chunk: Chunk) -> Iterator[Tensor]:
    """The recorded images of a chunk, some at a time, [V, H, W, 3] each."""
    for start in range(0, len(chunk.views), _BATCH):
        yield torch.stack(map_single_threaded(decode_view_image, chunk.views[start : start + _BATCH]))


def _digest_images(chunk: Chunk) -> str:
    """Sha256 of a chunk's images at the working resolution."""
    # By content: every stage reads the chunk from the store again, as another object.
    digest = hashlib.sha256(f"{chunk.width_px}×{chunk.height_px}".encode())
    for view in chunk.views:
        digest.update(f"{view.camera}/{view.frame}".encode() + hashlib.sha256(view.image).digest())
    return digest.hexdigest()
