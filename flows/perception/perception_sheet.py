"""One picture of what a detector finds: a column for each camera, the recorded image above the renders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from flows.perception.perceived_images import PerceivedImage
from genre_tasks.detection.drawing import draw_detections

_TILE_WIDTH_PX = 640
_TITLE_PX = 24
_FONT_PX = 14


def draw_sheet(perceived: Sequence[PerceivedImage], class_names: Sequence[str]) -> NDArray[np.uint8]:
    """Draws images of one frame with their detections.

    Args:
        perceived: at least one image, of any cameras, all of one size; recorded, and rendered at any shifts.
        class_names: the detector's.

    Returns:
        [H, W, 3] sRGB.
    """
    # In the order in which they came, which is that of the rig and of the shifts.
    cameras = list(dict.fromkeys(one.camera for one in perceived))
    rows = list(dict.fromkeys((one.source, one.shift_m) for one in perceived))
    height, width = perceived[0].image.shape[:2]
    # Small images stay as they are; enlarged ones would show nothing more.
    tile_width = min(width, _TILE_WIDTH_PX)
    tile_height = round(height * tile_width / width)
    sheet = Image.new("RGB", (tile_width * len(cameras), (tile_height + _TITLE_PX) * len(rows)), "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(_FONT_PX)
    for one in perceived:
        left = tile_width * cameras.index(one.camera)
        top = (tile_height + _TITLE_PX) * rows.index((one.source, one.shift_m))
        # Drawn at the tile's size, so that the labels can be read.
        scaled = _scale(one, tile_width, tile_height)
        picture = draw_detections(scaled.image, scaled.detections, class_names)
        where = "recorded" if one.source == "recorded" else f"rendered {one.shift_m:+g} m"
        # Short enough for an image of the presets' width.
        title = f"{one.camera} {one.frame}, {where}: {len(one.detections)}"
        draw.text((left + 4, top + 2), title, fill="black", font=font)
        sheet.paste(Image.fromarray(picture), (left, top + _TITLE_PX))
    return np.asarray(sheet).copy()


def _scale(perceived: PerceivedImage, width: int, height: int) -> PerceivedImage:
    """An image with its detections at another size."""
    if perceived.image.shape[:2] == (height, width):
        return perceived
    size = (width, height)
    factors = np.array([width / perceived.image.shape[1], height / perceived.image.shape[0]] * 2, np.float32)
    found = perceived.detections
    masks = found.masks
    if masks is not None:
        resized = [np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.NEAREST)) for mask in masks]
        masks = np.stack(resized) if resized else np.zeros((0, height, width), bool)
    image = np.asarray(Image.fromarray(perceived.image).resize(size, Image.Resampling.BILINEAR))
    return replace(perceived, image=image, detections=replace(found, boxes=found.boxes * factors, masks=masks))
