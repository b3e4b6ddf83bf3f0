"""Images freed of their lens's distortion, for layouts that have no place for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.brown_conrady import distort
from genre_tasks.logs.types import Lens
from genre_tasks.scene.lens_distortion import fold_radius
from genre_tasks.training_sets.box_outlines import box_corners, outline_box
from genre_tasks.training_sets.labelled_images import LabelledBox, LabelledImage


def rectify_labelled_image(labelled: LabelledImage) -> LabelledImage:
    """Resamples an image as a lens without distortion would have taken it, and projects its boxes again.

    Args:
        labelled: an image of any lens.

    Returns:
        The image with the same focal lengths and principal point; black where the recorded one shows nothing. The same
        object where the lens has no distortion.
    """
    if not any(labelled.lens.distortion):
        return labelled
    lens = replace(labelled.lens, distortion=())
    boxes = (_project_again(box, lens) for box in labelled.boxes)
    return replace(
        labelled,
        lens=lens,
        image=_resample(labelled.image, labelled.lens),
        boxes=tuple(box for box in boxes if box is not None),
    )


def _project_again(box: LabelledBox, lens: Lens) -> LabelledBox | None:
    outline = outline_box(box_corners(box.camera_SE3_box, np.array(box.size_m)), lens)
    # A barrel lens sees farther to the side than the image that is made of it.
    return None if outline is None else replace(box, box_px=outline.box_px, truncated=outline.truncated)


def _resample(image: NDArray[np.uint8], lens: Lens) -> NDArray[np.uint8]:
    """Bilinear between the four pixels around the place where each ray arrives."""
    height, width = image.shape[:2]
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    x = (u - lens.cx_px) / lens.fx_px
    y = (v - lens.cy_px) / lens.fy_px
    shown = x * x + y * y < fold_radius(lens.coefficients) ** 2
    bent_x, bent_y = distort(x, y, lens.coefficients)
    # From the edge of the first pixel to its centre.
    column = bent_x * lens.fx_px + lens.cx_px - 0.5
    row = bent_y * lens.fy_px + lens.cy_px - 0.5
    shown &= (column >= -0.5) & (column <= width - 0.5) & (row >= -0.5) & (row <= height - 0.5)
    column = np.where(shown, column, 0.0).clip(0, width - 1)
    row = np.where(shown, row, 0.0).clip(0, height - 1)
    left = np.floor(column).astype(np.int64)
    top = np.floor(row).astype(np.int64)
    right = np.minimum(left + 1, width - 1)
    bottom = np.minimum(top + 1, height - 1)
    across = (column - left)[..., None]
    down = (row - top)[..., None]
    upper = image[top, left] * (1 - across) + image[top, right] * across
    lower = image[bottom, left] * (1 - across) + image[bottom, right] * across
    mixed = np.where(shown[..., None], upper * (1 - down) + lower * down, 0.0)
    pixels: NDArray[np.uint8] = np.rint(mixed).astype(np.uint8)
    return pixels
