"""Metrics of a set of images: each against its truth where there is one, and all of them against the real images."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.errors import NonFiniteError
from genre_tasks.logs.types import Truth
from genre_tasks.metrics.distribution_distances import frechet_distance, kernel_distance
from genre_tasks.metrics.fid_lpips import Inception, Lpips, fid
from genre_tasks.metrics.image_quality import psnr, ssim
from genre_tasks.metrics.perceptual import perceptual_distance
from genre_tasks.metrics.results import Metric, ViewScore
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene.image_decoding import decode_image
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.threads import map_single_threaded

BOOTSTRAP_SEED = 0
"""The resamples over frames are the same for every stage and method, so that their intervals are comparable."""

_REAL_BATCH = 16
_KEPT_CHUNKS = 4
_KEPT_TRUTH_BYTES = 2**28


@dataclass(frozen=True)
class FeatureSet:
    """Pooled features of N images with the frame of each."""

    features: Tensor  # [N, 1280]
    frames: tuple[int, ...]


_real: OrderedDict[str, FeatureSet] = OrderedDict()


def real_images(chunk: Chunk) -> FeatureSet:
    """Features of all real images of a chunk at the working resolution: the reference of the distribution distances.

    Computed once per process and chunk (by content). Raises ``InputError`` for an image that cannot be decoded.
    """
    key = _contents(chunk)
    if key not in _real:
        parts = [torch.zeros((0, 1280))]
        for start in range(0, len(chunk.views), _REAL_BATCH):
            images = map_single_threaded(view_image, chunk.views[start : start + _REAL_BATCH])
            parts.append(perceptual_distance().pooled_features(torch.stack(images)))
        _real[key] = FeatureSet(torch.cat(parts), tuple(v.frame for v in chunk.views))
        if len(_real) > _KEPT_CHUNKS:
            _real.popitem(last=False)
    _real.move_to_end(key)
    return _real[key]


def _contents(chunk: Chunk) -> str:
    """Of its images at the working resolution."""
    digest = hashlib.sha256(f"{chunk.width_px}×{chunk.height_px}".encode())
    for view in chunk.views:
        digest.update(f"{view.camera}/{view.frame}".encode() + hashlib.sha256(view.image).digest())
    return digest.hexdigest()


_real_inception: dict[tuple[str, Inception], Tensor] = {}


def real_inception(chunk: Chunk, network: Inception) -> Tensor:
    """As :func:`real_images`, on the network that FID is of [N, 2048]; kept for the last chunk."""
    key = _contents(chunk), network
    if key not in _real_inception:
        parts = []
        for start in range(0, len(chunk.views), _REAL_BATCH):
            images = map_single_threaded(view_image, chunk.views[start : start + _REAL_BATCH])
            parts.append(network.features(torch.stack(images)))
        _real_inception.clear()
        _real_inception[key] = torch.cat(parts)
    return _real_inception[key]


def view_image(view: View) -> Tensor:
    """[H, W, 3] sRGB in [0, 1] at the working resolution."""
    return decode_image(view.image, view.lens.width_px, view.lens.height_px)


_true: OrderedDict[tuple[object, ...], tuple[Truth, NDArray[np.uint8]]] = OrderedDict()


def true_pixels(chunk: Chunk, truth: Truth, view: NovelView) -> NDArray[np.uint8]:
    """[H, W, 3] sRGB: what the camera would have seen. Every stage asks for the same views: the last are kept.

    Only an image's own truth object answers for it: the entry keeps the object, so that its id stays its own.
    """
    pose = chunk.world_SE3_chunk @ view.chunk_SE3_camera
    key = (id(truth), view.frame, pose.tobytes(), view.lens)
    if key not in _true:
        _true[key] = truth, truth.image(view.frame, pose, view.lens)
        while len(_true) > 1 and sum(image.nbytes for _, image in _true.values()) > _KEPT_TRUTH_BYTES:
            _true.popitem(last=False)
    _true.move_to_end(key)
    return _true[key][1]


@dataclass
class Collector:
    """Takes images batch by batch and keeps their scores and features, not the images.

    ``prefix`` goes before a metric's last word: ``render_`` makes ``shift_3m/render_psnr``. ``inception`` and ``lpips``
    are networks for FID and LPIPS proper, where the user gave them.
    """

    stage: str
    distributions: bool
    prefix: str = ""
    inception: Inception | None = None
    lpips: Lpips | None = None
    scores: list[ViewScore] = field(default_factory=list)
    _features: list[Tensor] = field(default_factory=list)
    _frames: list[int] = field(default_factory=list)
    _pooled: list[Tensor] = field(default_factory=list)
    _lpips: list[float] = field(default_factory=list)

    def add(
        self,
        views: Sequence[View | NovelView],  # V
        images: Tensor,  # [V, H, W, 3] sRGB in [0, 1]
        truths: Tensor | None,  # [V, H, W, 3]
    ) -> None:
        """Raises ``NonFiniteError`` naming camera and frame of an image that is not finite."""
        for view, image in zip(views, images, strict=True):
            bad = torch.nonzero(~torch.isfinite(image))
            if len(bad):
                index = tuple(int(i) for i in bad[0])
                where = {"camera": view.camera, "frame": view.frame}
                raise NonFiniteError(f"evaluate/{self.stage}", "image", len(bad), index, **where)
        if self.distributions:
            self._features.append(perceptual_distance().pooled_features(images))
            self._frames += [v.frame for v in views]
        if self.inception is not None:
            self._pooled.append(self.inception.features(images))
        if truths is not None:
            self.scores += scored(views, images, truths)
            if self.lpips is not None:
                self._lpips += self.lpips.distances(shown(views, images, truths), truths)

    def quality(self, group: str) -> list[Metric]:
        """``group/psnr``, ``ssim``, ``perceptual``: means over the images with truth; nothing if there are none."""
        n = len(self.scores)
        names = ("psnr", "ssim", "perceptual") if n else ()
        found = [Metric(f"{group}/{self.prefix}{k}", sum(getattr(s, k) for s in self.scores) / n, n) for k in names]
        if self._lpips:
            found.append(Metric(f"{group}/{self.prefix}lpips", sum(self._lpips) / n, n))
        return found

    def inception_distance(self, group: str, chunk: Chunk) -> list[Metric]:
        """``group/fid`` against all real images of the chunk, where there is a network for it and two images."""
        if self.inception is None or not self._pooled:
            return []
        features = torch.cat(self._pooled)
        value = fid(features, real_inception(chunk, self.inception))
        return [] if value is None else [Metric(f"{group}/{self.prefix}fid", value, len(features))]

    def distances(self, group: str, real: FeatureSet, bootstrap: int) -> list[Metric]:
        """``group/frechet`` and ``kernel`` with its interval; nothing where undefined (fewer than 2 images)."""
        if not self._features:
            return []
        features = torch.cat(self._features)
        found = {
            "frechet": frechet_distance(features, real.features),
            "kernel": kernel_distance(
                features, real.features, self._frames, real.frames, bootstrap, seed=BOOTSTRAP_SEED
            ),
        }
        return [
            Metric(f"{group}/{self.prefix}{name}", d.value, d.n, d.low, d.high)
            for name, d in found.items()
            if d is not None
        ]


def _where(shown: NDArray[np.bool_] | None, image: Tensor, truth: Tensor) -> Tensor:
    return image if shown is None else torch.where(torch.from_numpy(shown)[..., None], image, truth)


def _seen(views: Sequence[View | NovelView]) -> list[NDArray[np.bool_] | None]:
    return [~v.own if isinstance(v, View) and v.own is not None else None for v in views]


def shown(views: Sequence[View | NovelView], images: Tensor, truths: Tensor) -> Tensor:
    """``images`` with the truth where the vehicle itself is: that is no error, nor no merit."""
    seen = _seen(views)
    if all(s is None for s in seen):
        return images
    return torch.stack([_where(s, a, b) for s, a, b in zip(seen, images, truths, strict=True)])


def scored(views: Sequence[View | NovelView], images: Tensor, truths: Tensor) -> list[ViewScore]:
    """PSNR, SSIM and perceptual distance of each image [V, H, W, 3] against its truth, outside of ``View.own``."""
    images, seen = shown(views, images, truths), _seen(views)
    with torch.no_grad():
        perceptual = perceptual_distance()(images, truths).tolist()
    pairs = [(a.numpy(), b.numpy(), s) for a, b, s in zip(images, truths, seen, strict=True)]
    both = map_single_threaded(lambda pair: (psnr(*pair), ssim(*pair)), pairs)
    return [
        ViewScore(v.camera, v.frame, v.shift_m if isinstance(v, NovelView) else 0.0, p, s, d)
        for v, (p, s), d in zip(views, both, perceptual, strict=True)
    ]
