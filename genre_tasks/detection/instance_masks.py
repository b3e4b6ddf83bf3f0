"""Masks of objects from prototypes: each object's mask is a weighted sum of maps that all objects share."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.detection.image_fit import Placement
from genre_tasks.detection.suppression import Candidates
from genre_tasks.logs.types import Float32

PROTOTYPE_STRIDE = 4
"""A pixel of the prototypes covers so many pixels of the network's input along each axis."""


def build_masks(
    candidates: Candidates, prototypes: Float32, placement: Placement, width: int, height: int
) -> NDArray[np.bool_]:
    """Builds the masks of objects, each inside of its box.

    Args:
        candidates: M objects, with boxes in pixels of the image and coefficients.
        prototypes: [C, h, w] maps that the coefficients weigh.
        placement: where the image lies in the network's input.
        width: of the image, pixels.
        height: of the image, pixels.

    Returns:
        [M, height, width], true where the object is more likely than not.
    """
    masks = np.zeros((len(candidates.scores), height, width), bool)
    # By torch: NumPy's product of small matrices waits for threads where other work takes the cores.
    weights = torch.from_numpy(candidates.coefficients)
    logits = (weights @ torch.from_numpy(prototypes).flatten(1)).numpy().reshape(-1, *prototypes.shape[1:])
    for mask, logit, box in zip(masks, logits, candidates.boxes, strict=True):
        # Pixels whose centre is in the box; at least one along each axis, as thin boxes may have no centre inside.
        columns = _list_pixels(box[0], box[2], width)
        rows = _list_pixels(box[1], box[3], height)
        left, right, x_share = _find_neighbours(columns, placement.scale[0], placement.offset[0], logit.shape[1])
        upper, lower, y_share = _find_neighbours(rows, placement.scale[1], placement.offset[1], logit.shape[0])
        # Between the logits, and only in the box: a film of street scenes has hundreds of masks.
        by_row = logit[upper] * (1 - y_share)[:, None] + logit[lower] * y_share[:, None]
        values = by_row[:, left] * (1 - x_share) + by_row[:, right] * x_share
        # The sigmoid passes one half where its argument passes 0.
        mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = values > 0
    return masks


def _list_pixels(low: float, high: float, size: int) -> NDArray[np.int64]:
    """Indices of the pixels whose centre is between two edges."""
    first = min(int(np.ceil(low - 0.5)), size - 1)
    return np.arange(first, max(first + 1, min(size, int(np.ceil(high - 0.5)))))


def _find_neighbours(
    pixels: NDArray[np.int64], scale: float, offset: float, count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float32]:
    """The two prototypes' pixels around each of the image's pixels along an axis, and the share of the second."""
    place = (((pixels + 0.5) * scale + offset) / PROTOTYPE_STRIDE - 0.5).clip(0, count - 1)
    before = np.floor(place).astype(np.int64)
    return before, np.minimum(before + 1, count - 1), (place - before).astype(np.float32)
