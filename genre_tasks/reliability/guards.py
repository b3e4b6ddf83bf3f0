"""Signs of a render's quality that need no truth: agreement with recorded images, and what none of them shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from genre_tasks.detection.detector import Detector
from genre_tasks.fixer.warping import SourceImage
from genre_tasks.reliability.detected_actors import count_detected_actors
from genre_tasks.reliability.recorded_support import look_up_support
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.novel_views import NovelViews
from genre_tasks.threads import map_single_threaded

MIN_COVERAGE = 0.5
"""A pixel counts as covered from this alpha on."""

FLOATING_DEPTH = 0.5
"""A pixel floats where its rendered depth is below this fraction of the LiDAR map's."""

MAX_AGREEMENT_DB = 60.0
"""Agreement of an image that is exactly what recorded ones show."""

PSNR_COEFFICIENTS = {"constant": 18.14, "agreement_db": 0.2834, "shown": 5.947, "shift_m": -1.127}
"""PSNR in dB as a linear function of guards.

Least squares over 1224 views of the streets 900–905, on the path and up to 5 m beside it, in scenes of GNet and ENet of
preset ``small``. ``genre bench evaluation --set rounds=0 --set seeds=900,…`` prints the coefficients. Fitted with one
of the streets left out in turn, the rank correlation with the true PSNR is 0.873."""


@dataclass(frozen=True)
class Guards:
    """How well one render is supported, measured without the truth.

    Attributes:
        camera: name of the camera.
        frame: the log's frame.
        shift_m: distance to the left of the path, metres.
        agreement_db: PSNR between the render and recorded images that are looked up by the LiDAR's depth; 0 where
            these show nothing.
        shown: fraction of pixels whose rendered depth agrees with some recorded image.
        thin: fraction of pixels that are covered by less than half.
        floating: fraction of pixels whose rendered depth is less than half of the LiDAR's, where both are known.
        actors: actors of the log that are completely in the image; 0 without a detector.
        detected: how many of them the detector finds.
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
        """The PSNR that the view is likely to have, dB; see ``PSNR_COEFFICIENTS``."""
        return (
            PSNR_COEFFICIENTS["constant"]
            + PSNR_COEFFICIENTS["agreement_db"] * self.agreement_db
            + PSNR_COEFFICIENTS["shown"] * self.shown
            + PSNR_COEFFICIENTS["shift_m"] * abs(self.shift_m)
        )


def compute_guards(
    chunk: Chunk, novel: NovelViews, sources: Sequence[SourceImage], detector: Detector | None = None
) -> list[Guards]:
    """Measures how well rendered views are supported.

    Args:
        chunk: the chunk, with its plan's effects applied.
        novel: V rendered views with their LiDAR maps.
        sources: the chunk's recorded images, see :func:`genre_tasks.fixer.source_images.load_source_images`.
        detector: counts the actors that are still found; ``None``: they are not counted.

    Returns:
        V guards, in the order of ``novel.views``.
    """

    @torch.no_grad()
    def guard_view(index: int) -> Guards:
        return _guard_view(chunk, novel, index, sources)

    # Single views are too small to keep several threads busy, so that several views are measured at once.
    guards = map_single_threaded(guard_view, range(len(novel.views)))
    if detector is None:
        return guards
    # One after the other: not every detector may be called by several threads.
    return [_count_detected(guard, chunk, novel, index, detector) for index, guard in enumerate(guards)]


def _guard_view(chunk: Chunk, novel: NovelViews, index: int, sources: Sequence[SourceImage]) -> Guards:
    view = novel.views[index]
    support = look_up_support(chunk, novel, index, sources)
    # By the LiDAR's depth: looked up by its own depth, a floater would agree with the images that made it.
    # Clamped, as the image is shown.
    rendered = novel.color[index][support.covered].clamp(0, 1).T
    floating, known = _find_floating_pixels(novel, index)
    return Guards(
        camera=view.camera,
        frame=view.frame,
        shift_m=view.shift_m,
        agreement_db=_mean_psnr(((rendered - support.colors) ** 2).mean(0)),
        # By the render's own depth this time: does any image agree with the surface as it was rendered?
        shown=_fraction(support.shown),
        thin=_fraction(novel.alpha[index] < MIN_COVERAGE),
        # Only pixels with both depths can be judged; without any nothing floats.
        floating=float(floating.sum()) / max(1, int(known.sum())),
    )


def _count_detected(guard: Guards, chunk: Chunk, novel: NovelViews, index: int, detector: Detector) -> Guards:
    """The same guards with the actors that a detector finds."""
    image = novel.color[index].clamp(0, 1)
    actors, detected = count_detected_actors(detector, chunk, novel.views[index], image)
    return replace(guard, actors=actors, detected=detected)


def _find_floating_pixels(novel: NovelViews, index: int) -> tuple[Tensor, Tensor]:
    """Masks [H, W]: where a pixel floats, and where that is known because both depths are."""
    depth = novel.depth[index]
    lidar_depth = novel.lidar_depth[index]
    known = (novel.alpha[index] > MIN_COVERAGE) & (novel.lidar_alpha[index] > MIN_COVERAGE) & (lidar_depth > 0)
    return known & (depth < FLOATING_DEPTH * lidar_depth), known


def _mean_psnr(squared_error: Tensor) -> float:
    """PSNR in dB of squared errors; 0 without any: nothing speaks for the view."""
    if not squared_error.numel():
        return 0.0
    # The floor only keeps the logarithm finite: the cap is reached long before it.
    return min(MAX_AGREEMENT_DB, -10 * math.log10(max(float(squared_error.double().mean()), 1e-12)))


def _fraction(mask: Tensor) -> float:
    return float(mask.to(torch.float64).mean())
