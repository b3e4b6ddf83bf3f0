"""Training sets in the layout of nuScenes: the tables of ``v1.0-trainval`` and ``samples/CAMERA``.

Every log and path is a scene of its own: ``002-recorded``, ``002-left-3m``. Each frame of it is a sample, at the time
of its first camera by name; there are no LiDAR sweeps. A camera has one mount in a scene, that of its first image, and
each image's ``ego_pose`` follows from its camera's pose: cameras do not fire at one moment. It has one calibration in a
scene as well: an image of another size is refused. Where nothing says how much of an object is hidden, its visibility
is that of an object in full view. Where no sweep says how many LiDAR points an object has, the number is 1: tools of
nuScenes drop boxes without points.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.training_sets.image_files import name_image, name_viewpoint, write_image
from genre_tasks.training_sets.label_boxes import NO_SWEEP_POINTS
from genre_tasks.training_sets.labelled_images import LabelledBox, LabelledImage
from genre_tasks.training_sets.nuscenes_tables import ATTRIBUTES, NuScenesTables, find_attribute, find_category, token
from genre_tasks.training_sets.rectified_images import rectify_labelled_image

# nuScenes counts from the centre of the first pixel, as OpenCV's calibration does.
_PIXEL_CENTRE = 0.5
_US = 1_000_000
# Largest share that is hidden → visibility level.
_VISIBILITY = ((0.2, "4"), (0.4, "3"), (0.6, "2"), (1.0, "1"))


@dataclass
class _Sample:
    """A frame of a scene: times in µs by camera, and by track the box with its pose and velocity in the world."""

    times_us: dict[str, int] = field(default_factory=dict)
    boxes: dict[str, tuple[LabelledBox, Float64, Float64]] = field(default_factory=dict)


@dataclass(frozen=True)
class _Channel:
    """A camera of a scene as its first image has it: the log's name, mount, intrinsics [3][3], width and height."""

    camera: str
    vehicle_SE3_camera: Float64
    intrinsic: list[list[float]]
    size_px: tuple[int, int]


@dataclass
class _Scene:
    """A path of a log: its name in nuScenes, the frames, and the cameras by channel."""

    name: str
    log: str
    samples: dict[int, _Sample] = field(default_factory=dict)
    channels: dict[str, _Channel] = field(default_factory=dict)


class NuScenesWriter:
    """Writes a training set image by image; the tables at the end.

    Args:
        root: an empty folder.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._scenes: dict[str, _Scene] = {}
        self._tables = NuScenesTables()

    def add(self, labelled: LabelledImage) -> None:
        """Writes an image; that of a distorting lens is rectified.

        Args:
            labelled: the image.

        Raises:
            InputError: the camera has an image of that frame and path already, or one of another size or with other
                intrinsics; or another camera has the same name in nuScenes.
        """
        rectified = rectify_labelled_image(labelled)
        name = f"{labelled.log}-{name_viewpoint(labelled)}"
        scene = self._scenes.setdefault(name, _Scene(name, labelled.log))
        channel = name_channel(labelled.camera)
        # Before the file is written, which could replace that of another camera.
        problem_and_remedy = _find_problem(rectified, scene, channel)
        if problem_and_remedy:
            problem, remedy = problem_and_remedy
            where = {"log": labelled.log, "camera": labelled.camera, "frame": labelled.frame}
            raise InputError(problem, remedy=remedy, **where)  # type: ignore[arg-type]
        sample = scene.samples.setdefault(labelled.frame, _Sample())
        sample.times_us[channel] = round(labelled.timestamp_s * _US)
        filename = f"samples/{channel}/{name_image(labelled)}.png"
        write_image(self._root / filename, rectified.image)
        self._add_datum(rectified, scene, channel, filename)
        self._add_boxes(rectified, sample)

    def _add_datum(self, labelled: LabelledImage, scene: _Scene, channel: str, filename: str) -> None:
        tables = self._tables
        if channel not in scene.channels:
            mount = invert_se3(labelled.world_SE3_ego) @ labelled.world_SE3_camera
            intrinsic = _intrinsic_of(labelled.lens)
            scene.channels[channel] = _Channel(labelled.camera, mount, intrinsic, _size_px(labelled))
            tables.add_calibrated_sensor(scene.name, channel, mount, intrinsic)
        time_us = scene.samples[labelled.frame].times_us[channel]
        world_SE3_vehicle = labelled.world_SE3_camera @ invert_se3(scene.channels[channel].vehicle_SE3_camera)
        size_px = _size_px(labelled)
        tables.add_image(scene.name, channel, labelled.frame, time_us, world_SE3_vehicle, filename, size_px)

    @staticmethod
    def _add_boxes(labelled: LabelledImage, sample: _Sample) -> None:
        for box in labelled.boxes:
            # Several cameras may show an object; where most of it is visible says what is hidden.
            before = sample.boxes.get(box.track_id)
            if before is None or not _hidden(before[0]) <= _hidden(box):
                velocity = labelled.world_SE3_camera[:3, :3] @ np.array(box.velocity_m_s)
                pose = labelled.world_SE3_camera @ box.camera_SE3_box
                sample.boxes[box.track_id] = (box, pose, velocity)

    def finish(self) -> None:
        """Writes the tables."""
        tables = self._tables
        for name, scene in self._scenes.items():
            frames = sorted(scene.samples)
            # The clock of the project's reader, for which boxes stand at the sample's time.
            times_us = [scene.samples[frame].times_us[min(scene.samples[frame].times_us)] for frame in frames]
            tables.add_scene(name, scene.log, frames, times_us)
            tracks: dict[str, list[int]] = {}
            for frame in frames:
                for track_id in scene.samples[frame].boxes:
                    tracks.setdefault(track_id, []).append(frame)
            for track_id, track_frames in tracks.items():
                first = scene.samples[track_frames[0]].boxes[track_id][0]
                category = find_category(first.label)
                tables.add_instance(name, track_id, category, track_frames)
                for frame in track_frames:
                    box, pose, velocity = scene.samples[frame].boxes[track_id]
                    attribute = find_attribute(category, float(np.linalg.norm(velocity)))
                    facts = _describe_box(box, [token("attribute", attribute)] if attribute in ATTRIBUTES else [])
                    tables.add_annotation(name, track_id, frame, track_frames, pose, facts)
        tables.write(self._root)


def name_channel(camera: str) -> str:
    """Names a camera as nuScenes does.

    Args:
        camera: the log's name.

    Returns:
        In capitals, beginning with ``CAM_``.

    >>> name_channel("front_left_camera"), name_channel("CAM_BACK")
    ('CAM_FRONT_LEFT', 'CAM_BACK')
    """
    words = re.sub(r"[^A-Z0-9]+", "_", camera.upper()).strip("_").removesuffix("_CAMERA")
    return words if words.startswith("CAM_") else f"CAM_{words}"


def _find_problem(labelled: LabelledImage, scene: _Scene, channel: str) -> tuple[str, str] | None:
    """Why an image does not fit to those that its scene has already, and the remedy."""
    first = scene.channels.get(channel)
    if first is None:
        return None
    if first.camera != labelled.camera:
        problem = f"the cameras {first.camera} and {labelled.camera} are both {channel} in nuScenes"
        return problem, "Rename one of them in the log."
    if labelled.frame in scene.samples and channel in scene.samples[labelled.frame].times_us:
        return f"the scene {scene.name} has two images of one camera and frame", "Write each log and shift once."
    # Tools of nuScenes project all boxes of a scene and camera by one calibration.
    if (first.size_px, first.intrinsic) != (_size_px(labelled), _intrinsic_of(labelled.lens)):
        problem = f"the scene {scene.name} has images of one camera with different sizes or intrinsics"
        return problem, "Write a set for each run."
    return None


def _size_px(labelled: LabelledImage) -> tuple[int, int]:
    height, width = labelled.image.shape[:2]
    return width, height


def _intrinsic_of(lens: Lens) -> list[list[float]]:
    cx_px = lens.cx_px - _PIXEL_CENTRE
    cy_px = lens.cy_px - _PIXEL_CENTRE
    return [[lens.fx_px, 0.0, cx_px], [0.0, lens.fy_px, cy_px], [0.0, 0.0, 1.0]]


def _hidden(box: LabelledBox) -> float:
    return 0.0 if math.isnan(box.occluded) else box.occluded


def _describe_box(box: LabelledBox, attribute_tokens: list[str]) -> dict[str, Any]:
    length, width, height = box.size_m
    return {
        "size": [width, length, height],
        "num_lidar_pts": 1 if box.lidar_points == NO_SWEEP_POINTS else box.lidar_points,
        "num_radar_pts": 0,
        "visibility_token": next(level for limit, level in _VISIBILITY if _hidden(box) <= limit),
        "attribute_tokens": attribute_tokens,
    }
