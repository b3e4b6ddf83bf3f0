"""Detections as a table: a row for each, with its mask as a PNG."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from PIL import Image

from flows.perception.perceived_images import PerceivedImage
from genre_tasks.atomic_path import atomic_path
from storage.codecs.tables import column, schema, write_table

DETECTIONS_SCHEMA = schema(
    "detections/1",
    [
        column("camera", pa.string(), "of the rig"),
        column("frame", pa.int64(), "of the log"),
        column("shift_m", pa.float64(), "metres beside the path, left is positive"),
        column("source", pa.string(), "recorded or rendered"),
        column("class", pa.string(), "the detector's name of the class"),
        column("score", pa.float64(), "in [0, 1]"),
        column("x0_px", pa.float64(), "left edge of the box"),
        column("y0_px", pa.float64(), "upper edge of the box"),
        column("x1_px", pa.float64(), "right edge of the box"),
        column("y1_px", pa.float64(), "lower edge of the box"),
        column("mask", pa.binary(), "PNG of the image's size, white on the object; null without masks", nullable=True),
    ],
)


class DetectionsTable:
    """Collects detections, and writes them.

    Args:
        class_names: the detector's.
    """

    def __init__(self, class_names: tuple[str, ...]) -> None:
        self._class_names = class_names
        self._columns: dict[str, list[Any]] = {name: [] for name in DETECTIONS_SCHEMA.names}

    def add(self, perceived: PerceivedImage) -> None:
        """Adds the detections of an image; its pixels are not kept.

        Args:
            perceived: the image.
        """
        found = perceived.detections
        for index in range(len(found)):
            corners = (float(x) for x in found.boxes[index])
            row = (
                *(perceived.camera, perceived.frame, perceived.shift_m, perceived.source),
                *(self._class_names[found.classes[index]], float(found.scores[index]), *corners),
                None if found.masks is None else encode_mask(found.masks[index]),
            )
            # In the order of the schema.
            for values, value in zip(self._columns.values(), row, strict=True):
                values.append(value)

    def write(self, path: Path, facts: Mapping[str, str]) -> None:
        """Writes the table; it appears whole or not at all.

        Args:
            path: the file; its folder exists.
            facts: what the table says of itself, such as ``log`` and ``chunk``.

        Raises:
            OSError: the file cannot be written.
        """
        with atomic_path(path) as part:
            # The masks are compressed already.
            write_table(part, DETECTIONS_SCHEMA, self._columns, facts, raw=("mask",))


def encode_mask(mask: NDArray[np.bool_]) -> bytes:
    """Encodes a mask as a PNG of one bit a pixel.

    Args:
        mask: [H, W].

    Returns:
        The bytes of a PNG file, some hundred for the mask of a car.

    >>> np.asarray(Image.open(io.BytesIO(encode_mask(np.eye(3, dtype=bool))))).sum()
    np.int64(3)
    """
    sink = io.BytesIO()
    Image.fromarray(mask).save(sink, "PNG")
    return sink.getvalue()
