"""Pictures of detections: boxes, classes, scores and masks drawn on the image."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from genre_tasks.detection.detections import Detections

_HUE_STEP = 0.373
_TINT = 0.5


def choose_color(number: int) -> tuple[int, int, int]:
    """Chooses the colour of a class: the same one in all pictures.

    Args:
        number: of the class.

    Returns:
        sRGB, 0 to 255.

    >>> choose_color(0) == choose_color(0) and choose_color(0) != choose_color(1)
    True
    """
    # Of all steps around the circle of hues, one that sets COCO's six classes of road users far apart.
    red, green, blue = colorsys.hsv_to_rgb(number * _HUE_STEP % 1, 0.85, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def draw_detections(image: NDArray[np.uint8], detections: Detections, class_names: Sequence[str]) -> NDArray[np.uint8]:
    """Draws detections on an image.

    Args:
        image: [H, W, 3] sRGB; it stays as it is.
        detections: with boxes in pixels of the image.
        class_names: the detector's.

    Returns:
        [H, W, 3] sRGB: masks tinted, boxes, and class and score above each box.
    """
    canvas = image.copy()
    if detections.masks is not None:
        for number, mask in zip(detections.classes, detections.masks, strict=True):
            tint = _TINT * np.array(choose_color(int(number)))
            canvas[mask] = ((1 - _TINT) * canvas[mask] + tint).round().astype(np.uint8)
    picture = Image.fromarray(canvas)
    draw = ImageDraw.Draw(picture)
    # Legible at any size of the image: a line of text takes a fortieth of its height.
    font = ImageFont.load_default(max(10, image.shape[0] // 40))
    thickness = max(1, image.shape[0] // 360)
    # The best one last, so that nothing covers its label.
    for index in reversed(range(len(detections))):
        number = int(detections.classes[index])
        color = choose_color(number)
        left, top, right, bottom = (float(x) for x in detections.boxes[index])
        # Pillow draws the last row and column, too.
        corners = (left, top, max(left, right - 1), max(top, bottom - 1))
        draw.rectangle(corners, outline=color, width=thickness)
        text = f"{class_names[number]} {detections.scores[index]:.2f}"
        _draw_label(draw, text, (left, top), font, color)
    return np.asarray(picture).copy()


def _draw_label(
    draw: ImageDraw.ImageDraw,
    text: str,
    corner: tuple[float, float],
    font: ImageFont.ImageFont | ImageFont.FreeTypeFont,
    color: tuple[int, int, int],
) -> None:
    """Writes black text on the class's colour above a corner, or below it where the image ends."""
    _, _, width, height = draw.textbbox((0, 0), text, font=font)
    left = min(corner[0], max(0, draw.im.size[0] - width))
    top = corner[1] - height if corner[1] >= height else corner[1]
    draw.rectangle((left, top, left + width, top + height), fill=color)
    draw.text((left, top), text, fill="black", font=font)
