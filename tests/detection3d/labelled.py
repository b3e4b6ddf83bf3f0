"""Labelled images for tests of the detector: boxes as bright rectangles, made without any log."""

from __future__ import annotations

import numpy as np

from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.logs.types import Lens
from genre_tasks.training_sets.labelled_images import LabelledBox, LabelledImage

LENS = Lens(60.0, 60.0, 32.0, 24.0, 64, 48)
TINY = Detector3dConfig(
    width_px=64, height_px=48, width=16, batch=2, steps=4, warm_up=1, flip=0.0, zoom=0.0, shift=0.0, colour_jitter=0.0
)


def upright(x: float, y: float, z: float, heading: float) -> np.ndarray:
    """Camera_SE3_box of an upright box; a heading of 0 looks along the camera's axis."""
    pose = np.eye(4)
    pose[:3, 0] = (np.sin(heading), 0.0, np.cos(heading))
    pose[:3, 2] = (0.0, -1.0, 0.0)
    pose[:3, 1] = np.cross(pose[:3, 2], pose[:3, 0])
    pose[:3, 3] = (x, y, z)
    return pose


def labelled_box(
    x: float = 1.0,
    z: float = 15.0,
    heading: float = 0.3,
    label: str = "Car",
    size_m: tuple[float, float, float] = (4.2, 1.8, 1.5),
    lidar_points: int = 20,
    occluded: float = float("nan"),
    y: float = 1.0,
) -> LabelledBox:
    return LabelledBox(
        f"{label}-{x}-{z}", label, size_m, upright(x, y, z, heading), (0.0, 0.0, 1.0, 1.0), 0.0, occluded, lidar_points
    )


def labelled_image(*boxes: LabelledBox, frame: int = 0, lens: Lens = LENS) -> LabelledImage:
    """Grey, with a bright rectangle for each box, and a colour for its class."""
    pixels = np.full((lens.height_px, lens.width_px, 3), 60, np.uint8)
    for box in sorted(boxes, key=lambda box: -box.camera_SE3_box[2, 3]):
        x, y, z = box.camera_SE3_box[:3, 3]
        if z <= 0:
            continue
        u = lens.fx_px * x / z + lens.cx_px
        v = lens.fy_px * y / z + lens.cy_px
        half_width = lens.fx_px * box.size_m[1] / z / 2
        half_height = lens.fy_px * box.size_m[2] / z / 2
        rows = slice(max(0, round(v - half_height)), max(0, round(v + half_height)))
        columns = slice(max(0, round(u - half_width)), max(0, round(u + half_width)))
        pixels[rows, columns] = (220, 200, 40) if box.label == "Car" else (40, 90, 230)
    return LabelledImage(
        "street", "front_camera", frame, 0.1 * frame, 0.0, False, np.eye(4), np.eye(4), lens, pixels, tuple(boxes)
    )
