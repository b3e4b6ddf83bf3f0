"""What a detector found in an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32


@dataclass(frozen=True)
class Detections:
    """N objects that a detector found in one image, best score first.

    Attributes:
        boxes: [N, 4] x and y of the upper left, then of the lower right corner, pixels of the image, inside of it.
        scores: [N] in [0, 1].
        classes: [N] index of the class in the detector's list of class names.
        masks: [N, H, W], true where the object is; ``None`` from detectors that give boxes alone.
    """

    boxes: Float32
    scores: Float32
    classes: NDArray[np.int64]
    masks: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.scores)

    def select(self, kept: NDArray[np.bool_] | NDArray[np.int64]) -> Detections:
        """Takes some of the objects.

        Args:
            kept: [N] true for those to keep, or their indices in the wanted order.
        """
        # Detectors of boxes alone have no masks to select from.
        masks = None if self.masks is None else self.masks[kept]
        return Detections(self.boxes[kept], self.scores[kept], self.classes[kept], masks)
