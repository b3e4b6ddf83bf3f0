"""From candidates to detections: overlapping ones are left out, boxes are cut at the image's edges, best first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.detection.agreement import box_overlaps
from genre_tasks.detection.detections import Detections
from genre_tasks.logs.types import Float32

MAX_OVERLAP = 0.45
"""Of two boxes of a class that overlap more (intersection over union), only the one with the better score stays."""

MAX_DETECTIONS = 300
"""An image has at most so many detections, the best ones; a mask for each takes as much memory as the image."""


@dataclass(frozen=True)
class Candidates:
    """What a network's output says before overlapping boxes are left out.

    Attributes:
        boxes: [M, 4] x and y of the upper left, then of the lower right corner.
        scores: [M] in [0, 1].
        classes: [M] number of the class.
        coefficients: [M, C] weights of the C prototypes of masks; C is 0 for networks without masks.
    """

    boxes: Float32
    scores: Float32
    classes: NDArray[np.int64]
    coefficients: Float32

    def select(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Candidates:
        """Takes some of the candidates.

        Args:
            kept: [M] true for those to keep, or their indices in the wanted order.
        """
        return Candidates(self.boxes[kept], self.scores[kept], self.classes[kept], self.coefficients[kept])


def suppress_overlaps(
    boxes: Float32, scores: Float32, classes: NDArray[np.int64], max_overlap: float = MAX_OVERLAP
) -> NDArray[np.int64]:
    """Non-maximum suppression per class: of boxes of a class that overlap, the best one stays.

    Args:
        boxes: [M, 4] x and y of the upper left, then of the lower right corner.
        scores: [M].
        classes: [M] number of the class; boxes of different classes do not compete.
        max_overlap: boxes that overlap a better one more than this are left out.

    Returns:
        Indices of the boxes that stay, best score first; at most ``MAX_DETECTIONS``.

    >>> boxes = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [1, 0, 11, 10]], np.float32)
    >>> suppress_overlaps(boxes, np.array([0.6, 0.9, 0.5], np.float32), np.array([2, 2, 7])).tolist()
    [1, 2]
    """
    # Stable, so that equal scores stay in the network's order.
    remaining = np.argsort(-scores, kind="stable")
    kept: list[int] = []
    while len(remaining) and len(kept) < MAX_DETECTIONS:
        best = remaining[0]
        rest = remaining[1:]
        kept.append(int(best))
        # One row at a time: the table of all pairs would have millions of entries at a low least score.
        hidden = box_overlaps(boxes[best][None], boxes[rest])[0] > max_overlap
        remaining = rest[~(hidden & (classes[rest] == classes[best]))]
    return np.array(kept, np.int64)


def finish_candidates(candidates: Candidates, width: int, height: int) -> Candidates:
    """Leaves out overlapping candidates, and cuts boxes at the image's edges.

    Args:
        candidates: with boxes in pixels of the image.
        width: of the image, pixels.
        height: of the image, pixels.

    Returns:
        Those that stay and have an area inside of the image, best score first.
    """
    # Before the cut: at an edge, cut boxes of two objects could become the same.
    best = candidates.select(suppress_overlaps(candidates.boxes, candidates.scores, candidates.classes))
    limits = np.array([width, height, width, height], np.float32)
    boxes = best.boxes.clip(0, limits)
    inside = (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])
    return Candidates(boxes, best.scores, best.classes, best.coefficients).select(inside)


def sort_detections(detections: Detections, min_score: float, width: int, height: int) -> Detections:
    """Brings detections of a library, which has left out overlapping ones, into this room's form.

    Args:
        detections: in any order.
        min_score: those with a lower score are left out.
        width: of the image, pixels.
        height: of the image, pixels.

    Returns:
        The detections with boxes inside of the image, best score first.
    """
    limits = np.array([width, height, width, height], np.float32)
    boxes = detections.boxes.clip(0, limits)
    # Libraries have least scores of their own, which may be lower.
    good = (detections.scores >= min_score) & (boxes[:, 2:] > boxes[:, :2]).all(1)
    cut = Detections(boxes, detections.scores, detections.classes, detections.masks)
    order = np.argsort(-detections.scores, kind="stable")
    return cut.select(order[good[order]][:MAX_DETECTIONS])
