"""Training sets in COCO's layout: ``images/`` and ``annotations.json``, which pycocotools reads.

Rectangles are x, y, width and height in pixels from the image's upper left corner. Each image and box has more than
COCO knows, which readers of COCO pass over: the log, camera, frame and shift; the track, and how much of it is cut off
or hidden.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from genre_tasks.training_sets.image_files import name_image, write_image, write_json
from genre_tasks.training_sets.labelled_images import LabelledBox, LabelledImage

_IMAGES = "images"


class CocoWriter:
    """Writes a training set image by image.

    Args:
        root: an empty folder.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []
        self._category_ids: dict[str, int] = {}

    def add(self, labelled: LabelledImage) -> None:
        """Writes an image.

        Args:
            labelled: of any lens, since rectangles need no calibration.
        """
        # The number keeps names apart where several runs have the same log.
        name = f"{len(self._images):06d}_{name_image(labelled)}.png"
        write_image(self._root / _IMAGES / name, labelled.image)
        image_id = len(self._images) + 1
        height, width = labelled.image.shape[:2]
        self._images.append(
            {
                "id": image_id,
                "file_name": name,
                "width": width,
                "height": height,
                # Beyond COCO's own keys, which readers skip: where the image is from.
                "log": labelled.log,
                "camera": labelled.camera,
                "frame": labelled.frame,
                "shift_m": labelled.shift_m,
                "rendered": labelled.rendered,
            }
        )
        # Numbers from 1: evaluations take 0 for no match.
        self._annotations += [
            self._describe_box(box, image_id, len(self._annotations) + k) for k, box in enumerate(labelled.boxes, 1)
        ]

    def finish(self) -> None:
        """Writes the annotations."""
        categories = [{"id": number, "name": label} for label, number in self._category_ids.items()]
        tables = {"images": self._images, "annotations": self._annotations, "categories": categories}
        info = {"description": "images of driving logs, recorded and rendered, with boxes of their annotation"}
        write_json(self._root / "annotations.json", {"info": info, "licenses": [], **tables})

    def _describe_box(self, box: LabelledBox, image_id: int, number: int) -> dict[str, Any]:
        left, top, right, bottom = box.box_px
        return {
            "id": number,
            "image_id": image_id,
            "category_id": self._category_ids.setdefault(box.label, len(self._category_ids) + 1),
            "bbox": [left, top, right - left, bottom - top],
            "area": (right - left) * (bottom - top),
            "iscrowd": 0,
            # Trainers of masks expect one; a rectangle says no more than the box.
            "segmentation": [[left, top, right, top, right, bottom, left, bottom]],
            "track_id": box.track_id,
            "truncated": box.truncated,
            "occluded": None if math.isnan(box.occluded) else box.occluded,
            "lidar_points": box.lidar_points,
        }
