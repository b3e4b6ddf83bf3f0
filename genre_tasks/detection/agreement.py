"""How far a detector's finds in two sets of images agree: those on recorded images are taken for the truth.

A find on a rendered image is matched with one of the same class on the recorded image, best score first, as COCO's
evaluation does it. The paper averages over instances: so do these numbers, over all finds on recorded images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.detection.detections import Detections
from genre_tasks.logs.types import Float64

RECALL_POINTS = np.linspace(0, 1, 101)
"""Where COCO reads the precision off: at recalls of 0, 0.01, …, 1."""

MIN_OVERLAP = 0.5
"""Intersection over union from which two finds are of one object."""


@dataclass(frozen=True)
class ClassMatches:
    """Finds of one class in one image, matched.

    Attributes:
        scores: [F] of the finds in the image that is judged.
        matched: [F] whether each find has a partner in the reference.
        overlaps: [R] intersection over union of each find in the reference with its partner; 0 without one.
    """

    scores: Float64
    matched: NDArray[np.bool_]
    overlaps: Float64


ImageMatches = dict[int, ClassMatches]
"""The matches of one image, by class."""


@dataclass(frozen=True)
class Agreement:
    """How far finds agree with the reference.

    Attributes:
        average_precision: mean of the classes' average precision, each weighed by its instances; NaN without any.
        recall: share of the reference's instances that were found.
        mean_overlap: mean intersection over union of all instances, 0 for one that was not found.
        matched_overlap: the same over those that were found; NaN if none was.
        instances: number of instances in the reference.
    """

    average_precision: float
    recall: float
    mean_overlap: float
    matched_overlap: float
    instances: int


def compare_detections(
    reference: Sequence[Detections],
    found: Sequence[Detections],
    classes: Sequence[int] | None = None,
    overlap: float = MIN_OVERLAP,
    *,
    of_masks: bool = False,
) -> Agreement:
    """Compares a detector's finds in pairs of images.

    Args:
        reference: finds in each recorded image.
        found: finds in each image that is judged, in the same order.
        classes: the classes that count; all if ``None``.
        overlap: intersection over union from which two finds are of one object, in (0, 1].
        of_masks: whether masks overlap, and not boxes.

    Returns:
        The agreement over all images.

    Raises:
        ValueError: the sequences differ in length, or finds have no masks.

    >>> box = np.array([[0, 0, 10, 10]], np.float32)
    >>> car = Detections(box, np.ones(1, np.float32), np.array([2]))
    >>> compare_detections([car], [car]).average_precision
    1.0
    """
    matches = [match_image(r, f, classes, overlap, of_masks=of_masks) for r, f in zip(reference, found, strict=True)]
    return summarise_matches(matches)


def match_image(
    reference: Detections,
    found: Detections,
    classes: Sequence[int] | None = None,
    overlap: float = MIN_OVERLAP,
    *,
    of_masks: bool = False,
) -> ImageMatches:
    """Matches the finds in one image with those of the reference.

    Args:
        reference: finds in the recorded image.
        found: finds in the image that is judged.
        classes: the classes that count; all if ``None``.
        overlap: intersection over union from which two finds are of one object, in (0, 1].
        of_masks: whether masks overlap, and not boxes.

    Returns:
        The matches of each class that either image has.

    Raises:
        ValueError: finds have no masks.
    """
    overlaps = mask_overlaps(reference, found) if of_masks else box_overlaps(reference.boxes, found.boxes)
    present = np.union1d(reference.classes, found.classes).tolist()
    chosen = [name for name in present if classes is None or name in classes]
    return {
        name: _match_class(
            overlaps[np.ix_(reference.classes == name, found.classes == name)],
            found.scores[found.classes == name].astype(np.float64),
            overlap,
        )
        for name in chosen
    }


def _match_class(overlaps: Float64, scores: Float64, least: float) -> ClassMatches:
    """Matches finds [F] with instances [R] by their overlaps [R, F]."""
    partner = np.zeros(len(overlaps))
    matched = np.zeros(len(scores), bool)
    # The stable order decides between equal scores, as in COCO's evaluation.
    for find in np.argsort(-scores, kind="stable"):
        # An instance that has a partner is left to it, whatever overlap a weaker find has.
        free = np.where(partner == 0, overlaps[:, find], -1.0)
        if len(free) and free.max() >= least:
            # The last of equal overlaps, as COCO takes it.
            best = len(free) - 1 - int(free[::-1].argmax())
            partner[best] = free[best]
            matched[find] = True
    return ClassMatches(scores, matched, partner)


def summarise_matches(images: Sequence[ImageMatches]) -> Agreement:
    """Computes the agreement over images.

    Args:
        images: matches of each image.
    """
    classes = sorted({name for image in images for name in image})
    precisions = {name: average_precision([image[name] for image in images if name in image]) for name in classes}
    # Classes that the reference lacks have no instance that could be found: COCO leaves them out, too.
    overlaps = {
        name: np.concatenate([np.zeros(0), *(image[name].overlaps for image in images if name in image)])
        for name in classes
    }
    instances = sum(len(values) for values in overlaps.values())
    if not instances:
        return Agreement(math.nan, math.nan, math.nan, math.nan, 0)
    pooled = np.concatenate(list(overlaps.values()))
    weighted = sum(len(overlaps[name]) * precisions[name] for name in classes if len(overlaps[name]))
    is_found = pooled > 0
    return Agreement(
        average_precision=float(weighted / instances),
        recall=float(is_found.mean()),
        mean_overlap=float(pooled.mean()),
        matched_overlap=float(pooled[is_found].mean()) if is_found.any() else math.nan,
        instances=instances,
    )


def average_precision(matches: Sequence[ClassMatches]) -> float:
    """Computes the average precision of one class as COCO does: precision at 101 recalls, interpolated from the right.

    Args:
        matches: of the class in each image.

    Returns:
        A number in [0, 1]; NaN where the reference has no instance.
    """
    total = sum(len(image.overlaps) for image in matches)
    if not total:
        return math.nan
    scores = np.concatenate([image.scores for image in matches])
    matched = np.concatenate([image.matched for image in matches])[np.argsort(-scores, kind="mergesort")]
    hits = matched.cumsum()
    recall = hits / total
    precision = hits / np.arange(1, len(hits) + 1)
    # What is reached at a higher recall may be had at a lower one, too.
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    places = np.searchsorted(recall, RECALL_POINTS, side="left")
    return float(np.where(places < len(recall), np.append(envelope, 0.0)[places], 0.0).mean())


def box_overlaps(first: NDArray[np.float32], second: NDArray[np.float32]) -> Float64:
    """Computes the intersection over union of every pair of boxes.

    Args:
        first: [R, 4] two opposite corners, pixels.
        second: [F, 4].

    Returns:
        [R, F] in [0, 1]; 0 where both boxes have no area.

    >>> box_overlaps(np.array([[0, 0, 2, 2]]), np.array([[1, 0, 3, 2]])).round(3).tolist()
    [[0.333]]
    """
    # In float64, since products of pixels lose digits in float32.
    a = np.asarray(first, np.float64)[:, None]
    b = np.asarray(second, np.float64)[None]
    common = (np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])).clip(0).prod(-1)
    union = (a[..., 2:] - a[..., :2]).prod(-1) + (b[..., 2:] - b[..., :2]).prod(-1) - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


def mask_overlaps(reference: Detections, found: Detections) -> Float64:
    """Computes the intersection over union of every pair of masks.

    Args:
        reference: R finds with masks.
        found: F finds with masks of the same size.

    Returns:
        [R, F] in [0, 1]; 0 where both masks are empty.

    Raises:
        ValueError: finds have no masks.
    """
    if reference.masks is None or found.masks is None:
        raise ValueError("expected finds with masks, got boxes alone")
    result = np.zeros((len(reference), len(found)))
    for i, first in enumerate(reference.masks):
        for j, second in enumerate(found.masks):
            union = int((first | second).sum())
            result[i, j] = int((first & second).sum()) / union if union else 0.0
    return result


def resample_images(
    methods: Sequence[Sequence[ImageMatches]],
    measure: Callable[[Sequence[Agreement]], float],
    resamples: int = 1000,
    seed: int = 0,
) -> tuple[float, float]:
    """Bootstraps a number over images, the same images for every method, since instances of an image are not alone.

    Args:
        methods: for each method the matches of the same images.
        measure: gives the number, such as a difference, from the methods' agreements.
        resamples: how many.
        seed: of the random numbers.

    Returns:
        Bounds of the 95 % interval; NaN where fewer than two images, or no resample has the number.
    """
    count = len(methods[0])
    random = np.random.default_rng(seed)
    values = []
    for _ in range(resamples if count > 1 else 0):
        chosen = random.integers(0, count, count)
        value = measure([summarise_matches([images[k] for k in chosen]) for images in methods])
        if math.isfinite(value):
            values.append(value)
    if not values:
        return math.nan, math.nan
    low, high = np.percentile(values, (2.5, 97.5))
    return float(low), float(high)
