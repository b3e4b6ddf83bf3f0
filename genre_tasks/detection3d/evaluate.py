"""How well a detector finds the boxes of labelled images: average precision by centre distance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from genre_tasks.detection3d.average_precision import Centres, DetectionScores, score_class
from genre_tasks.detection3d.decode import Detections3d
from genre_tasks.detection3d.detector import Detector3d
from genre_tasks.detection3d.examples import select_boxes
from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64
from genre_tasks.progress import Progress, silent
from genre_tasks.training_sets.labelled_images import LabelledImage


def evaluate_detector(
    detector: Detector3d, images: Sequence[LabelledImage], progress: Progress = silent
) -> DetectionScores:
    """Scores a detector; each image is a sample of its own.

    Args:
        detector: trained.
        images: that it was not trained on.
        progress: called with the images done and their total.

    Returns:
        Average precision by class and threshold.

    Raises:
        InputError: there are no images, or a box is not finite.
    """
    found = []
    for n, image in enumerate(images):
        progress(n, len(images), "detect")
        found.append(detector.detect(image.image, image.lens))
    progress(len(images), len(images), "detect")
    return score_detections(found, images, detector.config)


def score_detections(
    found: Sequence[Detections3d], images: Sequence[LabelledImage], config: Detector3dConfig
) -> DetectionScores:
    """Compares detections with the boxes that count.

    Args:
        found: detections of each image.
        images: as many, with their boxes.
        config: classes, which boxes count, and thresholds.

    Returns:
        Average precision by class and threshold.

    Raises:
        InputError: there are no images, or a box is not finite.
    """
    if not images:
        raise InputError("there are no images to evaluate on", remedy="Choose logs with images and boxes.")
    # The rule of training: what cannot be seen cannot be missed.
    truth = [select_boxes(image, config) for image in images]
    classes = []
    for kind, settings in enumerate(config.classes):
        samples = [n for n, boxes in enumerate(truth) for box_kind, _ in boxes if box_kind == kind]
        # On the ground, which is the plane of x and z in camera axes.
        centres = [box.camera_SE3_box[[0, 2], 3] for boxes in truth for box_kind, box in boxes if box_kind == kind]
        detected, scores = _collect(found, kind, config.max_range_m)
        true = Centres(np.array(samples, np.int64), np.array(centres, np.float64).reshape(-1, 2))
        classes.append(score_class(settings.name, true, detected, scores, config.thresholds_m))
    return DetectionScores(tuple(classes), len(images))


def _collect(found: Sequence[Detections3d], kind: int, max_range_m: float) -> tuple[Centres, Float64]:
    """Centres and scores of one class in all images, as far as truth is counted."""
    samples = []
    centres = []
    scores = []
    for n, detections in enumerate(found):
        positions = detections.camera_SE3_box[:, [0, 2], 3]
        # Detections beyond the range of the truth would all be false.
        counts = (detections.classes == kind) & (np.linalg.norm(positions, axis=1) < max_range_m)
        samples.append(np.full(int(counts.sum()), n))
        centres.append(positions[counts])
        scores.append(detections.scores[counts])
    return Centres(np.concatenate(samples), np.concatenate(centres)), np.concatenate(scores)
