"""Average precision by the distance of centres on the ground, as the nuScenes detection benchmark defines it.

A detection and a true box match where their centres are near each other on the ground plane; size and orientation do
not count. Here the ground plane is the camera's x–z plane: cameras of vehicles are nearly level, so that the up axis of
a box is nearly −y. The benchmark's own thresholds are 0.5, 1, 2 and 4 m; the paper's table reports 1, 2 and 4 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64

RECALLS = np.linspace(0.0, 1.0, 101)
"""Recalls at which precision is read off its curve."""

MIN_RECALL = 0.1
MIN_PRECISION = 0.1
THRESHOLDS_M = (1.0, 2.0, 4.0)
"""Distances within which a detection matches; nuScenes has 0.5 m too, where a single camera finds next to nothing."""


@dataclass(frozen=True)
class Centres:
    """Centres of the boxes of one class in all samples.

    Attributes:
        samples: [N] index of the sample, that is the image, of each box.
        centres_m: [N, 2] x and z in camera axes, metres.
    """

    samples: NDArray[np.int64]
    centres_m: Float64

    def __len__(self) -> int:
        return len(self.samples)


def match_detections(truth: Centres, found: Centres, scores: Float64, threshold_m: float) -> NDArray[np.bool_]:
    """Decides which detections are right, from the best score to the worst.

    Each detection takes the nearest true box of its sample that no better one has taken, if that is near enough. Of
    equal scores the later detection comes first, as in the benchmark.

    Args:
        truth: true boxes.
        found: detections.
        scores: [N] of the detections.
        threshold_m: a match is nearer than this.

    Returns:
        [N] whether a detection matches, sorted by descending score.

    Raises:
        InputError: a score or a centre is not finite.

    >>> truth = Centres(np.array([0]), np.array([[0.0, 10.0]]))
    >>> found = Centres(np.array([0, 0]), np.array([[0.0, 10.5], [0.1, 10.0]]))
    >>> match_detections(truth, found, np.array([0.9, 0.8]), 1.0)
    array([ True, False])
    """
    _require_finite(truth, found, scores)
    rows_of: dict[int, list[int]] = {}
    for row, sample in enumerate(truth.samples.tolist()):
        rows_of.setdefault(sample, []).append(row)
    order = np.lexsort((np.arange(len(scores)), scores))[::-1]
    is_match = np.zeros(len(order), dtype=bool)
    for n, index in enumerate(order.tolist()):
        # What is left of the sample: matched boxes are taken out below.
        rows = rows_of.get(int(found.samples[index]), [])
        if not rows:
            continue
        distances = np.linalg.norm(truth.centres_m[rows] - found.centres_m[index], axis=1)
        nearest = int(np.argmin(distances))
        if distances[nearest] < threshold_m:
            rows.pop(nearest)
            is_match[n] = True
    return is_match


def interpolate_precision(is_match: NDArray[np.bool_], truth_count: int) -> Float64:
    """Reads the precision at 101 recalls.

    Args:
        is_match: [N] sorted by descending score.
        truth_count: number of true boxes.

    Returns:
        [101] precision at recalls 0, 0.01, …, 1; 0 at recalls that are not reached.

    >>> interpolate_precision(np.array([True, False]), 2)[[0, 50, 51]]
    array([1. , 0.5, 0. ])
    """
    if truth_count == 0 or len(is_match) == 0:
        return np.zeros(len(RECALLS))
    right = np.cumsum(is_match).astype(np.float64)
    precision = right / np.arange(1, len(is_match) + 1)
    recall = right / truth_count
    # The curve begins at recall 0 with the precision of the best detection.
    if recall[0] != 0:
        recall = np.concatenate([[0.0], recall])
        precision = np.concatenate([precision[:1], precision])
    return np.interp(RECALLS, recall, precision, right=0.0)


def average_precision(
    precision: Float64, min_recall: float = MIN_RECALL, min_precision: float = MIN_PRECISION
) -> float:
    """Averages precision over recall, without the part that needs no skill.

    Args:
        precision: [101] at recalls 0, 0.01, …, 1.
        min_recall: recalls up to this one do not count, in [0, 1).
        min_precision: is subtracted, and the rest scaled to reach 1, in [0, 1).

    Returns:
        In [0, 1].

    Raises:
        InputError: a limit is out of range.

    >>> round(average_precision(np.ones(101)), 9)
    1.0
    """
    if not 0 <= min_recall < 1 or not 0 <= min_precision < 1:
        raise InputError(
            f"a least recall of {min_recall:g} and a least precision of {min_precision:g} leave nothing to average",
            remedy="Choose both from 0 up to, but not including, 1.",
        )
    # The recall at the limit is itself left out, since version 1.0 of the benchmark.
    counted = precision[round(100 * min_recall) + 1 :]
    return float(np.maximum(counted - min_precision, 0.0).mean() / (1.0 - min_precision))


@dataclass(frozen=True)
class ClassScores:
    """How well one class is found.

    Attributes:
        name: of the class.
        truth_count: number of true boxes that count.
        found_count: number of detections that count.
        average_precisions: threshold in metres → average precision; 0 where there is no true box.
    """

    name: str
    truth_count: int
    found_count: int
    average_precisions: dict[float, float]

    @property
    def mean(self) -> float:
        """Mean of the average precisions over thresholds."""
        return float(np.mean(list(self.average_precisions.values())))


@dataclass(frozen=True)
class DetectionScores:
    """How well boxes are found.

    Attributes:
        classes: in the order of the detector's classes.
        images: number of images.
    """

    classes: tuple[ClassScores, ...]
    images: int

    @property
    def mean_average_precision(self) -> float:
        """Mean over classes and thresholds (mAP).

        Classes without a single true box are left out; the benchmark, which has boxes of all classes, counts them as 0.
        NaN where there is no true box at all.
        """
        present = [scores.mean for scores in self.classes if scores.truth_count]
        return float(np.mean(present)) if present else float("nan")

    @property
    def truth_count(self) -> int:
        """Number of true boxes of all classes."""
        return sum(scores.truth_count for scores in self.classes)

    def at_threshold(self, threshold_m: float) -> float:
        """Average precision at one threshold: the mean over classes that have a true box.

        Args:
            threshold_m: one of the thresholds, metres.

        Returns:
            In [0, 1]; NaN where there is no true box at all.

        Raises:
            InputError: there is no such threshold.
        """
        present = [scores.average_precisions for scores in self.classes if scores.truth_count]
        if any(threshold_m not in values for values in present):
            known = ", ".join(f"{threshold:g}" for threshold in present[0])
            raise InputError(f"there is no threshold of {threshold_m:g} m", remedy=f"Choose one of {known} m.")
        return float(np.mean([values[threshold_m] for values in present])) if present else float("nan")


def score_class(
    name: str, truth: Centres, found: Centres, scores: Float64, thresholds_m: Sequence[float] = THRESHOLDS_M
) -> ClassScores:
    """Scores the detections of one class.

    Args:
        name: of the class.
        truth: true boxes.
        found: detections.
        scores: [N] of the detections.
        thresholds_m: distances within which a detection matches.

    Returns:
        The average precision at each threshold.

    Raises:
        InputError: a score or a centre is not finite.

    >>> truth = Centres(np.array([0]), np.array([[0.0, 10.0]]))
    >>> round(score_class("car", truth, truth, np.array([0.9])).average_precisions[1.0], 9)
    1.0
    """
    values = {}
    for threshold in thresholds_m:
        is_match = match_detections(truth, found, scores, threshold)
        values[float(threshold)] = average_precision(interpolate_precision(is_match, len(truth)))
    return ClassScores(name, len(truth), len(found), values)


def _require_finite(truth: Centres, found: Centres, scores: Float64) -> None:
    named = (("true centre", truth.centres_m), ("detected centre", found.centres_m), ("score", scores))
    for name, values in named:
        if not np.isfinite(values).all():
            raise InputError(f"a {name} is not finite", remedy="Check the boxes and the detector that they come from.")
