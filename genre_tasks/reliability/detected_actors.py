"""Which of the log's actors a detector finds in a render: what a stack in simulation would still see."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.detection.agreement import box_overlaps
from genre_tasks.detection.coco_classes import find_road_users, require_road_users
from genre_tasks.detection.detector import Detector, open_detector
from genre_tasks.logs.types import Float32
from genre_tasks.scene.box_projection import AnyView, project_box
from genre_tasks.scene.chunk import Chunk

MIN_SCORE = 0.5
"""A detection counts from this score on."""

MIN_OVERLAP = 0.5
"""A detection finds an actor if their boxes in the image overlap at least so much (intersection over union)."""

MIN_HEIGHT_PX = 14
"""Actors whose box is lower in the image are not looked for."""


def open_actor_detector(path_or_name: str) -> Detector:
    """Opens a detector that is to find the log's actors.

    Args:
        path_or_name: as :func:`genre_tasks.detection.detector.open_detector` takes it.

    Returns:
        The detector, whose finds have a score of at least ``MIN_SCORE``.

    Raises:
        ConfigError: a package that the detector needs is not installed.
        InputError: there is no such detector, or it knows no road users.
    """
    detector = open_detector(path_or_name, min_score=MIN_SCORE)
    # It would find no actor on the path either, so that nothing could be lost beside it.
    require_road_users(detector.class_names, path_or_name)
    return detector


def count_detected_actors(detector: Detector, chunk: Chunk, view: AnyView, image: Tensor) -> tuple[int, int]:
    """Counts which of a chunk's actors a detector finds in an image.

    Args:
        detector: its finds of road users count.
        chunk: the chunk with its actors.
        view: where the image is from.
        image: [H, W, 3] sRGB in [0, 1], at the size of the view's lens.

    Returns:
        How many actors are completely in the image and not too small, and how many of them are detected.
    """
    boxes = [project_box(actor, view) for actor in chunk.actors]
    expected = [np.concatenate([low, high]) for low, high in boxes if _is_detectable(low, high, view)]
    # Without actors to find the network need not run.
    if not expected:
        return 0, 0
    # Rounded as a file of the render would be.
    found = detector.detect(_round_to_bytes(image))
    finds = found.boxes[np.isin(found.classes, find_road_users(detector.class_names))]
    return len(expected), _count_overlapped(np.array(expected, np.float32), finds)


def _round_to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """An image [H, W, 3] in [0, 1] in the 8 bits that detectors take."""
    pixels: NDArray[np.uint8] = (image.detach().float().clamp(0, 1) * 255).round().cpu().numpy().astype(np.uint8)
    return pixels


def _is_detectable(low: NDArray[np.int64], high: NDArray[np.int64], view: AnyView) -> bool:
    """Whether a box is completely in the image and not too small; a cut box would not match a detection."""
    inside = low[0] > 0 and low[1] > 0 and high[0] < view.lens.width_px and high[1] < view.lens.height_px
    return bool(inside and high[1] - low[1] >= MIN_HEIGHT_PX)


def _count_overlapped(boxes: Float32, finds: Float32) -> int:
    """How many boxes have a find with an intersection over union of at least ``MIN_OVERLAP``."""
    return int((box_overlaps(boxes, finds) >= MIN_OVERLAP).any(1).sum())
