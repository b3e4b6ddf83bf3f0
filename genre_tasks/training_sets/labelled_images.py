"""Images with labelled boxes, recorded or rendered: what training sets and detectors of boxes in space exchange."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float64, Lens


@dataclass(frozen=True)
class LabelledBox:
    """An annotated object as one camera sees it.

    Attributes:
        track_id: the log's name for the object.
        label: its class, in the log's words.
        size_m: length, width, height.
        camera_SE3_box: [4, 4] float64; camera axes x right, y down, z forward; box axes x forward, y left, z up.
        box_px: x and y of the upper left, then of the lower right corner of its rectangle, cut at the image's edges.
        truncated: share of the uncut rectangle that lies outside the image, in [0, 1].
        occluded: share of the object that nearer surfaces hide, in [0, 1]; NaN where no depth says it.
        lidar_points: points of the frame's sweep inside the box; −1 where the frame has no sweep.
        velocity_m_s: [3] in camera axes; zeros where the track has no second pose near the frame.
    """

    track_id: str
    label: str
    size_m: tuple[float, float, float]
    camera_SE3_box: Float64
    box_px: tuple[float, float, float, float]
    truncated: float
    occluded: float
    lidar_points: int
    velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LabelledImage:
    """An image with its boxes.

    Attributes:
        log: name of the log.
        camera: name of the camera.
        frame: log frame.
        timestamp_s: when the image was taken.
        shift_m: metres to the left of the recorded path; 0 on it.
        rendered: whether a scene was rendered, and not a camera's image recorded.
        world_SE3_camera: [4, 4] float64.
        world_SE3_ego: [4, 4] float64 pose of the vehicle, moved as the camera is.
        lens: of the image's size.
        image: [H, W, 3] sRGB.
        boxes: of the objects that are at least partly in the image.
    """

    log: str
    camera: str
    frame: int
    timestamp_s: float
    shift_m: float
    rendered: bool
    world_SE3_camera: Float64
    world_SE3_ego: Float64
    lens: Lens
    image: NDArray[np.uint8]
    boxes: tuple[LabelledBox, ...]
