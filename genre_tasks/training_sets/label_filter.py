"""Which boxes a detector can learn: those of which its image shows something."""

from __future__ import annotations

from dataclasses import replace

from genre_tasks.training_sets.labelled_images import LabelledBox, LabelledImage

MAX_OCCLUDED = 0.95
"""More of an object hidden than this leaves nothing to learn."""


def keep_visible_boxes(image: LabelledImage, min_points: int = 1, max_occluded: float = MAX_OCCLUDED) -> LabelledImage:
    """Leaves out the boxes that no detector could find.

    Args:
        image: with all boxes.
        min_points: LiDAR points that a box needs; boxes of frames without a sweep stay.
        max_occluded: share that may be hidden; boxes of which it is not known stay.

    Returns:
        The image with the other boxes.
    """
    boxes = tuple(box for box in image.boxes if _is_visible(box, min_points, max_occluded))
    return replace(image, boxes=boxes)


def _is_visible(box: LabelledBox, min_points: int, max_occluded: float) -> bool:
    has_points = box.lidar_points < 0 or box.lidar_points >= min_points
    # Every comparison with NaN is false, which keeps the box.
    return has_points and not box.occluded > max_occluded
