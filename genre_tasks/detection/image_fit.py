"""Images at the size that a network takes, and the way back from the network's pixels to the image's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from genre_tasks.detection.output_forms import Fit, OutputForm
from genre_tasks.logs.types import Float32

MARGIN_GREY = 114
"""The margin's grey, as in the training of the YOLO families."""


@dataclass(frozen=True)
class Placement:
    """Where an image lies in a network's input.

    Attributes:
        scale: pixels of the input for a pixel of the image, along x and y.
        offset: x and y of the image's upper left corner in the input, pixels.
    """

    scale: tuple[float, float]
    offset: tuple[float, float]

    def to_image(self, boxes: Float32) -> Float32:
        """Moves boxes from the network's input to the image.

        Args:
            boxes: [M, 4] corners in pixels of the input.

        Returns:
            [M, 4] corners in pixels of the image.

        >>> Placement((0.5, 0.5), (0, 10)).to_image(np.array([[0, 10, 50, 60]], np.float32)).tolist()
        [[0.0, 0.0, 100.0, 100.0]]
        """
        moved = (boxes - np.array(self.offset * 2, np.float32)) / np.array(self.scale * 2, np.float32)
        return moved.astype(np.float32)


def fit_image(image: NDArray[np.uint8], input_size: tuple[int, int], form: OutputForm) -> tuple[Float32, Placement]:
    """Brings an image to a network's size, order of channels and range of values.

    Args:
        image: [H, W, 3] sRGB.
        input_size: height and width of the network's input.
        form: what the network takes.

    Returns:
        [1, 3, height, width], and where the image lies in it.
    """
    height, width = input_size
    rows, columns = image.shape[:2]
    # Stretched images fill the input, whatever their shape is.
    scaled_size = (width, height)
    if form.fit is not Fit.STRETCHED:
        scale = min(width / columns, height / rows)
        scaled_size = (max(1, round(columns * scale)), max(1, round(rows * scale)))
    # Pillow's filter widens when it makes images smaller, so that thin structures do not alias.
    scaled = np.asarray(Image.fromarray(image).resize(scaled_size, Image.Resampling.BILINEAR))
    centred = form.fit is Fit.CENTRED
    left = (width - scaled_size[0]) // 2 if centred else 0
    top = (height - scaled_size[1]) // 2 if centred else 0
    canvas = np.full((height, width, 3), MARGIN_GREY, np.uint8)
    canvas[top : top + scaled_size[1], left : left + scaled_size[0]] = scaled
    channels = canvas[..., ::-1] if form.blue_first else canvas
    values = channels.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(form.divisor)
    # The scale of the rounded size: rounding moves far edges by up to half a pixel.
    placement = Placement((scaled_size[0] / columns, scaled_size[1] / rows), (float(left), float(top)))
    return np.ascontiguousarray(values), placement
