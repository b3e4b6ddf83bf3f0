"""Training sets in the layout of KITTI's object benchmark.

``training/image_2``, ``training/label_2`` and ``training/calib`` hold a file for each image, ``ImageSets/train.txt``
its number, and ``images.csv`` what the number stands for. Camera 2 is the image's own camera, and the rectified frame
is that camera's. KITTI turns boxes about the camera's y axis alone: what a box is tilted against the camera is lost,
and its centre is kept. There are no point clouds; the pose of the LiDAR is in ``Tr_velo_to_cam``.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from genre_tasks.logs.types import Float64, Lens
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.training_sets.class_words import ClassWords, find_class
from genre_tasks.training_sets.image_files import write_image
from genre_tasks.training_sets.labelled_images import LabelledBox, LabelledImage
from genre_tasks.training_sets.rectified_images import rectify_labelled_image

# Objects of other kinds come first: a cone of a construction site is no truck.
KITTI_CLASSES: ClassWords = (
    ("Misc", frozenset({"sign", "cone", "pylon", "barrier", "barrel", "bollard", "container", "rack", "animal"})),
    ("Cyclist", frozenset({"cyclist", "bicyclist", "bicycle", "bike", "rider", "motorcyclist"})),
    ("Pedestrian", frozenset({"pedestrian", "person", "human", "adult", "child", "walker", "signaler"})),
    ("Tram", frozenset({"tram", "train", "trolley", "subway", "railed"})),
    ("Misc", frozenset({"motorcycle", "motorbike", "scooter", "trailer", "towed", "pedicab", "moped", "mobility"})),
    ("Van", frozenset({"van"})),
    # KITTI's trucks are lorries.
    ("Car", frozenset({"pickup"})),
    ("Truck", frozenset({"truck", "bus", "lorry", "semi", "construction", "large"})),
    ("Car", frozenset({"car", "vehicle", "suv", "sedan"})),
)
_OTHER = "Misc"
# As the labels of KITTI were made by eye: fully visible, partly occluded, largely occluded, unknown.
_OCCLUSION_LEVELS = ((0.1, 0), (0.5, 1), (1.0, 2))
_UNKNOWN_OCCLUSION = 3
# KITTI counts from the centre of the first pixel.
_PIXEL_CENTRE = 0.5
_COLUMNS = ("number", "log", "camera", "frame", "timestamp_s", "shift_m", "rendered")


class KittiWriter:
    """Writes a training set image by image.

    Args:
        root: an empty folder.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._rows: list[tuple[object, ...]] = []
        for name in ("image_2", "label_2", "calib"):
            (root / "training" / name).mkdir(parents=True)

    def add(self, labelled: LabelledImage) -> None:
        """Writes image, labels and calibration; an image of a distorting lens is rectified.

        Args:
            labelled: the image.
        """
        rectified = rectify_labelled_image(labelled)
        number = f"{len(self._rows):06d}"
        folder = self._root / "training"
        write_image(folder / "image_2" / f"{number}.png", rectified.image)
        lines = [format_kitti_label(box, rectified.lens) for box in rectified.boxes]
        (folder / "label_2" / f"{number}.txt").write_text("".join(f"{line}\n" for line in lines), encoding="ascii")
        (folder / "calib" / f"{number}.txt").write_text(_format_calibration(rectified), encoding="ascii")
        facts = (labelled.log, labelled.camera, labelled.frame, repr(labelled.timestamp_s), f"{labelled.shift_m:g}")
        self._rows.append((number, *facts, int(labelled.rendered)))

    def finish(self) -> None:
        """Writes the list of numbers, and what they stand for."""
        sets = self._root / "ImageSets"
        sets.mkdir()
        (sets / "train.txt").write_text("".join(f"{row[0]}\n" for row in self._rows), encoding="ascii")
        with (self._root / "images.csv").open("w", encoding="utf-8", newline="") as file:
            table = csv.writer(file)
            table.writerow(_COLUMNS)
            table.writerows(self._rows)


def format_kitti_label(box: LabelledBox, lens: Lens) -> str:
    """Writes a box as a line of a label file.

    Args:
        box: in the axes of the rectified camera.
        lens: of the image.

    Returns:
        Type, truncated, occluded, alpha, rectangle, height, width, length, bottom centre and rotation about y.
    """
    length, width, height = box.size_m
    x, y, z = (float(value) for value in box.camera_SE3_box[:3, 3])
    forward = box.camera_SE3_box[:3, 0]
    # A turn by ry takes the camera's x axis to (cos ry, 0, −sin ry).
    rotation_y = math.atan2(-float(forward[2]), float(forward[0]))
    alpha = rotation_y - math.atan2(x, z)
    alpha = math.atan2(math.sin(alpha), math.cos(alpha))
    limits = (lens.width_px - 1, lens.height_px - 1) * 2
    edges = [min(max(edge - _PIXEL_CENTRE, 0.0), limit) for edge, limit in zip(box.box_px, limits, strict=True)]
    numbers = [*edges, height, width, length, x, y + height / 2, z, rotation_y]
    kind = find_class(box.label, KITTI_CLASSES, _OTHER)
    parts = [kind, f"{box.truncated:.2f}", str(_occlusion_level(box.occluded)), f"{alpha:.4f}"]
    return " ".join([*parts, *(f"{number:.4f}" for number in numbers)])


def _occlusion_level(occluded: float) -> int:
    return next((level for limit, level in _OCCLUSION_LEVELS if occluded <= limit), _UNKNOWN_OCCLUSION)


def _format_calibration(labelled: LabelledImage) -> str:
    lens = labelled.lens
    projection = np.zeros((3, 4))
    projection[0, 0] = lens.fx_px
    projection[1, 1] = lens.fy_px
    projection[:2, 2] = lens.cx_px - _PIXEL_CENTRE, lens.cy_px - _PIXEL_CENTRE
    projection[2, 2] = 1.0
    camera_SE3_lidar = invert_se3(labelled.world_SE3_camera) @ labelled.world_SE3_ego
    # One camera stands for all four: only the second one has images.
    matrices = {f"P{k}": projection for k in range(4)}
    matrices |= {"R0_rect": np.eye(3), "Tr_velo_to_cam": camera_SE3_lidar[:3], "Tr_imu_to_velo": np.eye(4)[:3]}
    return "".join(f"{name}: {_format_matrix(matrix)}\n" for name, matrix in matrices.items())


def _format_matrix(matrix: Float64) -> str:
    return " ".join(f"{value:.12e}" for value in matrix.ravel())
