"""Quality of distilled scenes at novel views: scores, when one is as good as another, and when a curve gets there."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.common.pipeline_inputs import render_images
from benchmarks.common.task import OptimisationTask
from genre_tasks.metrics.distribution_distances import kernel_distance
from genre_tasks.metrics.perceptual import perceptual_distance
from genre_tasks.metrics.scoring import FeatureSet
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import NovelView

KERNEL_PART = 0.01
PSNR_DB = 0.1
"""As good as: the kernel distance at most this fraction above, the PSNR at most so much below."""


@dataclass(frozen=True)
class NovelViewScorer:
    """Scores a scene at novel views 3 m from the path.

    Attributes:
        views: that are rendered for the kernel distance.
        real: features of the chunk's real images.
        task: with the truth at novel views, where there is one, and the held-out views.
    """

    views: tuple[NovelView, ...]
    real: FeatureSet
    task: OptimisationTask

    def score(self, scene: SceneGraph, seconds: float, renders: int) -> NovelViewScore:
        """Scores a scene.

        Args:
            scene: to render.
            seconds: time of the run so far.
            renders: views rendered so far.

        Returns:
            NovelViewScore: with both numbers of effort.
        """
        features = perceptual_distance().pooled_features(render_images(scene, self.views))
        frames = [v.frame for v in self.views]
        # The bootstrap gives an interval, which a curve has no use for.
        found = kernel_distance(features, self.real.features, frames, self.real.frames, bootstrap=0)
        assert found is not None
        return NovelViewScore(seconds, renders, found.value, self.task.psnr_novel(scene), self.task.psnr(scene))


@dataclass(frozen=True)
class NovelViewScore:
    """Quality of a scene after some effort.

    Attributes:
        seconds: time of the run.
        renders: views rendered.
        kernel: distance at 3 m to the real images, unbiased: it may be below 0.
        novel_psnr: dB at 3 m; ``None`` on a real log, which has no truth there.
        heldout: PSNR on held-out views, dB.
    """

    seconds: float
    renders: int
    kernel: float
    novel_psnr: float | None
    heldout: float

    def shortfall(self, other: NovelViewScore) -> tuple[float, float]:
        """Computes how far this score is from being as good as another.

        Args:
            other: to compare with.

        Returns:
            Missing kernel distance and missing dB; it is as good where both are at most 0.
        """
        # The distance may be negative, so the tolerance is a fraction of its absolute value.
        kernel = self.kernel - other.kernel - KERNEL_PART * abs(other.kernel)
        if self.novel_psnr is None or other.novel_psnr is None:
            return kernel, 0.0
        return kernel, other.novel_psnr - PSNR_DB - self.novel_psnr

    def is_as_good_as(self, other: NovelViewScore) -> bool:
        """Whether both the kernel distance and the PSNR are as good as another score's, within the tolerances.

        >>> first = NovelViewScore(1.0, 8, 0.201, None, 25.0)
        >>> first.is_as_good_as(NovelViewScore(4.0, 32, 0.2, None, 25.0))
        True
        """
        return max(self.shortfall(other)) <= 0

    def as_row(self) -> list[float | None]:
        """Seconds, renders, kernel distance, PSNR at 3 m, held-out PSNR."""
        novel_psnr = None if self.novel_psnr is None else round(self.novel_psnr, 3)
        return [round(self.seconds, 3), self.renders, round(self.kernel, 5), novel_psnr, round(self.heldout, 3)]


ScoreCurve = Sequence[NovelViewScore]


def time_to_match(curve: ScoreCurve, best: NovelViewScore) -> float | None:
    """Finds when a curve, linear between its scores, first is as good as a score.

    Args:
        curve: in order of time, the start's score first.
        best: to reach.

    Returns:
        Seconds; ``None`` where it never is. The start does not count.
    """
    for before, after in itertools.pairwise(curve):
        if after.is_as_good_as(best):
            # The start was as good already: distillation brought nothing, and no crossing can be interpolated.
            if before.is_as_good_as(best):
                return after.seconds
            # Both measures have to be as good, so the later of the two crossings counts.
            parts = [
                a / (a - b) if a > 0 else 0.0
                for a, b in zip(before.shortfall(best), after.shortfall(best), strict=True)
            ]
            return before.seconds + max(parts) * (after.seconds - before.seconds)
    return None
