"""Training sets in COCO's layout: ``images/`` and ``annotations.json``, which pycocotools reads.

Rectangles are x, y, width and height in pixels from the image's upper left corner. Each image and box has more than
COCO knows, which readers of COCO pass over: the log, camera, frame and shift; the track, and how much of it is cut off
or hidden. Classes are numbered in the order of their names, so sets with different classes have different numbers: join
them by name.
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
        self._boxes: list[tuple[int, LabelledBox]] = []

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
        self._boxes += [(image_id, box) for box in labelled.boxes]

    def finish(self) -> None:
        """Writes the annotations."""
        # Sorted: in the order of the images, two sets of the same classes would number them differently.
        category_ids = {label: k for k, label in enumerate(sorted({box.label for _, box in self._boxes}), 1)}
        categories = [{"id": number, "name": label} for label, number in category_ids.items()]
        # Numbers from 1: evaluations take 0 for no match.
        annotations = [
            _describe_box(box, number, image_id, category_ids[box.label])
            for number, (image_id, box) in enumerate(self._boxes, 1)
        ]
        tables = {"images": self._images, "annotations": annotations, "categories": categories}
        info = {"description": "images of driving logs, recorded and rendered, with boxes of their annotation"}
        write_json(self._root / "annotations.json", {"info": info, "licenses": [], **tables})


def _describe_box(box: LabelledBox, number: int, image_id: int, category_id: int) -> dict[str, Any]:
    left, top, right, bottom = box.box_px
    return {
        "id": number,
        "image_id": image_id,
        "category_id": category_id,
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
