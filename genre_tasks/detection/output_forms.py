"""Families of detectors, recognised by the shapes of what a network takes and gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

STRIDES = (8, 16, 32)
"""The YOLO families predict on grids whose cells are so many pixels wide."""

FASTESTDET_STRIDE = 16

SUPPORTED_FORMS = (
    "Supported are networks of one image [1, 3, H, W] or [1, H, W, 3] of these forms, N being the cells of grids of "
    "8, 16 and 32 pixels and K the classes: FastestDet [1, 5+K, H/16, W/16], YOLOX [1, N, 5+K], "
    "YOLOv5 [1, 3N, 5+K], YOLOv8 and 11 [1, 4+K, N] (with masks [1, 4+K+C, N] and [1, C, H/4, W/4]), "
    "YOLOv10 [1, M, 6]."
)
"""What the remedy of an error says."""


class Family(Enum):
    """Detectors whose input and output mean the same."""

    FASTESTDET = "FastestDet"
    YOLOX = "YOLOX"
    YOLOV5 = "YOLOv5"
    YOLOV8 = "YOLOv8"
    END_TO_END = "YOLOv10"


class Fit(Enum):
    """How an image comes to the size that a network takes."""

    STRETCHED = "stretched"
    CORNER = "scaled, with a margin at the right and at the bottom"
    CENTRED = "scaled, with margins at both sides"


@dataclass(frozen=True)
class OutputForm:
    """What a network takes and gives.

    Attributes:
        family: decides how the output is decoded.
        class_count: number of classes; ``None`` where the shape does not say it.
        mask_channels: number of prototypes of masks; 0 where the network gives boxes alone.
    """

    family: Family
    class_count: int | None
    mask_channels: int = 0

    @property
    def fit(self) -> Fit:
        """How the image is brought to the network's size, as in the family's training."""
        if self.family is Family.FASTESTDET:
            return Fit.STRETCHED
        return Fit.CORNER if self.family is Family.YOLOX else Fit.CENTRED

    @property
    def blue_first(self) -> bool:
        """Whether the channels are blue, green, red."""
        return self.family in (Family.FASTESTDET, Family.YOLOX)

    @property
    def divisor(self) -> float:
        """By what values in 0..255 are divided."""
        return 1.0 if self.family is Family.YOLOX else 255.0


def recognise_form(input_size: tuple[int, int], shapes: Sequence[tuple[int, ...]]) -> OutputForm | None:
    """Recognises the family of a detector.

    Args:
        input_size: height and width of the image that the network takes.
        shapes: of the network's outputs, masks' prototypes with their channels before rows and columns.

    Returns:
        The form, or ``None`` if the shapes are of none that is supported.

    >>> recognise_form((416, 416), [(1, 3549, 85)]).family.value
    'YOLOX'
    >>> recognise_form((640, 640), [(1, 116, 8400), (1, 32, 160, 160)])
    OutputForm(family=<Family.YOLOV8: 'YOLOv8'>, class_count=80, mask_channels=32)
    """
    height, width = input_size
    rows = [shape for shape in shapes if len(shape) == 3]
    maps = [shape for shape in shapes if len(shape) == 4]
    # A batch would be several images, of which all but the first were lost.
    if any(shape[0] != 1 for shape in shapes) or len(rows) + len(maps) != len(shapes):
        return None
    if not rows and len(maps) == 1:
        grid = (height // FASTESTDET_STRIDE, width // FASTESTDET_STRIDE)
        fits = maps[0][2:] == grid and maps[0][1] > 5
        return OutputForm(Family.FASTESTDET, maps[0][1] - 5) if fits else None
    # YOLOv5's export can have the three grids as outputs, too; the rows repeat what they say, but no file has both.
    if len(rows) != 1 or len(maps) > 1 or (maps and maps[0][2:] != (height // 4, width // 4)):
        return None
    return _recognise_rows(rows[0], count_cells(input_size), maps[0][1] if maps else 0)


def count_cells(input_size: tuple[int, int]) -> int:
    """Counts the cells of the grids of all strides.

    Args:
        input_size: height and width, pixels.

    >>> count_cells((640, 640))
    8400
    """
    return sum((input_size[0] // stride) * (input_size[1] // stride) for stride in STRIDES)


def _recognise_rows(shape: tuple[int, ...], cells: int, mask_channels: int) -> OutputForm | None:
    """The form of an output [1, A, B] for an input with so many cells."""
    _, first, second = shape
    # YOLOX predicts one box in each cell, YOLOv5 three: the factor tells them apart.
    if first == cells and second > 5 and not mask_channels:
        return OutputForm(Family.YOLOX, second - 5)
    if first == 3 * cells and second - mask_channels > 5:
        return OutputForm(Family.YOLOV5, second - 5 - mask_channels, mask_channels)
    if second == cells and first - mask_channels > 4:
        return OutputForm(Family.YOLOV8, first - 4 - mask_channels, mask_channels)
    # Last, as any other family could have as many numbers in a row by chance.
    if second == 6 + mask_channels:
        return OutputForm(Family.END_TO_END, None, mask_channels)
    return None
