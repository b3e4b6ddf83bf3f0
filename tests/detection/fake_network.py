"""A network that gives the same outputs for every image, and keeps what it was given."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass
class FakeNetwork:
    """Stands for a network in a file."""

    input_size: tuple[int, int]
    outputs: list[np.ndarray]
    metadata: dict[str, str] = field(default_factory=dict)
    given: list[np.ndarray] = field(default_factory=list)

    def run(self, image: np.ndarray) -> list[np.ndarray]:
        assert image.shape == (1, 3, *self.input_size) and image.dtype == np.float32
        self.given.append(image)
        return self.outputs


def yolov8_rows(size: tuple[int, int], finds: list[tuple[int, list[float]]], classes: int) -> np.ndarray:
    """YOLOv8's output [1, 4 + K, N], with the columns (box and what follows) of some cells."""
    cells = sum((size[0] // s) * (size[1] // s) for s in (8, 16, 32))
    rows = np.zeros((1, 4 + classes, cells), np.float32)
    # The last cell's centre is where it is in any image: in the lower right corner.
    rows[0, :4, -1] = (size[1] - 16, size[0] - 16, 32, 32)
    for cell, column in finds:
        rows[0, : len(column), cell] = column
    return rows
