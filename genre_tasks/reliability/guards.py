"""What a render beside the path tells of its own quality: agreement with recorded images, and what none has seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from genre_tasks.fixer.conditioning import degraded
from genre_tasks.fixer.warping import SourceImage
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_views import NovelView, NovelViews

if TYPE_CHECKING:
    from genre_tasks.reliability.detector import Detector

SEEN = 0.5
"""A pixel counts where at least so much of it is shown by recorded images (or, of alpha, is covered)."""

FLOATING = 0.5
"""What is nearer than this part of the LiDAR map's depth floats."""

MOST_DB = 60.0
"""Agreement of an image that is exactly what recorded ones show."""

ESTIMATE = {"constant": 18.14, "agreement_db": 0.2834, "shown": 5.947, "shift_m": -1.127}
"""PSNR in dB as a linear function of guards: least squares over 1224 views of the streets 900–905, up to 5 m beside the
path and on it, scenes of GNet and ENet of preset ``small`` (``genre bench evaluation --set rounds=0 --set seeds=900,…``
prints it). Fitted with one of the streets left out in turn, its rank correlation with the true PSNR is 0.873."""


@dataclass(frozen=True)
class Guards:
    """Of one view, all without the truth.

    ``agreement_db``: PSNR between the render and recorded images looked up by LiDAR's depth, where these show anything.
    ``shown``: share of pixels whose rendered depth some recorded image bears out. ``thin``: share of pixels that are
    covered by less than half. ``floating``: share whose rendered depth is less than half of LiDAR's, where both are.
    ``actors``: how many of the log's are wholly in the image, ``detected`` by a detector; 0 without one.
    """

    camera: str
    frame: int
    shift_m: float
    agreement_db: float
    shown: float
    thin: float
    floating: float
    actors: int = 0
    detected: int = 0

    @property
    def estimate_db(self) -> float:
        """The PSNR that the view is likely to have, dB; see ``ESTIMATE``."""
        return (
            ESTIMATE["constant"]
            + ESTIMATE["agreement_db"] * self.agreement_db
            + ESTIMATE["shown"] * self.shown
            + ESTIMATE["shift_m"] * abs(self.shift_m)
        )


def guards_of(
    chunk: Chunk, novel: NovelViews, sources: Sequence[SourceImage], detector: Detector | None = None
) -> list[Guards]:
    """Of each view; ``sources`` are the chunk's, see ``fixer.conditioning.recorded``."""
    return [_guards(chunk, novel, index, view, sources, detector) for index, view in enumerate(novel.views)]


def _guards(
    chunk: Chunk,
    novel: NovelViews,
    index: int,
    view: NovelView,
    sources: Sequence[SourceImage],
    detector: Detector | None,
) -> Guards:
    found = degraded(chunk, novel, [index], sources)
    shown = found.lidar_warp_mask > SEEN
    own = found.lidar_warped / found.lidar_warp_mask.clamp_min(SEEN)
    error = ((found.color.clamp(0, 1) - own) ** 2).mean(1, keepdim=True)
    near, known = _floating(novel, index)
    image = found.color[0].clamp(0, 1).permute(1, 2, 0)
    actors, detected = (0, 0) if detector is None else detector.found(chunk, view, image)
    return Guards(
        view.camera,
        view.frame,
        view.shift_m,
        _decibels(error[shown]),
        _share(found.warp_mask > SEEN),
        _share(found.alpha < SEEN),
        float(near.sum()) / max(1, int(known.sum())),
        actors,
        detected,
    )


def _floating(novel: NovelViews, index: int) -> tuple[Tensor, Tensor]:
    """Where a pixel floats, and where that can be told."""
    depth, lidar = novel.depth[index], novel.lidar_depth[index]
    known = (novel.alpha[index] > SEEN) & (novel.lidar_alpha[index] > SEEN) & (lidar > 0)
    return known & (depth < FLOATING * lidar), known


def _decibels(error: Tensor) -> float:
    """0 where nothing can be compared: nothing speaks for the view."""
    if not error.numel():
        return 0.0
    return min(MOST_DB, -10 * math.log10(max(float(error.double().mean()), 1e-12)))


def _share(mask: Tensor) -> float:
    return float(mask.to(torch.float64).mean())
