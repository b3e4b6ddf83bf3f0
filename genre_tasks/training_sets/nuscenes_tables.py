"""The thirteen tables of nuScenes: rows that point to one another by tokens."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.logs.types import Float64
from genre_tasks.training_sets.class_words import ClassWords, find_class
from genre_tasks.training_sets.image_files import write_image, write_json

VERSION = "v1.0-trainval"
_TABLES = (
    *("attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample"),
    *("sample_annotation", "sample_data", "scene", "sensor", "visibility"),
)
ATTRIBUTES = ("vehicle.moving", "vehicle.parked", "pedestrian.moving", "pedestrian.standing")
"""The attributes that a velocity tells."""

_VISIBILITIES = {"1": (0, 40), "2": (40, 60), "3": (60, 80), "4": (80, 100)}
# Slower, annotations of a standing object wander as fast.
_MOVING_M_S = 0.5
# Objects of other kinds come first: a cone of a construction site is no vehicle.
NUSCENES_CATEGORIES: ClassWords = (
    ("movable_object.trafficcone", frozenset({"cone", "pylon"})),
    ("movable_object.barrier", frozenset({"barrier"})),
    ("movable_object.debris", frozenset({"sign", "container", "debris", "barrel", "bollard"})),
    ("animal", frozenset({"animal", "dog", "bird"})),
    ("vehicle.bicycle", frozenset({"bicycle", "bike", "cyclist", "bicyclist"})),
    ("vehicle.motorcycle", frozenset({"motorcycle", "motorbike", "motorcyclist", "scooter", "moped"})),
    ("human.pedestrian.personal_mobility", frozenset({"mobility"})),
    ("human.pedestrian.adult", frozenset({"pedestrian", "person", "human", "walker", "signaler"})),
    ("vehicle.trailer", frozenset({"trailer", "towed"})),
    ("vehicle.construction", frozenset({"construction"})),
    ("vehicle.bus.rigid", frozenset({"bus", "tram", "train", "trolley", "subway", "railed"})),
    ("vehicle.truck", frozenset({"truck", "lorry", "semi", "large"})),
    ("vehicle.car", frozenset({"car", "van", "vehicle", "suv", "sedan", "pickup"})),
)


def token(*names: object) -> str:
    """Makes a row's token, the same for the same names.

    Args:
        names: table, scene and whatever else tells the row apart.

    Returns:
        32 hexadecimal digits.

    >>> len(token("scene", "002-recorded"))
    32
    """
    return hashlib.sha256("\0".join(map(str, names)).encode()).hexdigest()[:32]


def find_category(label: str) -> str:
    """Finds nuScenes' category of a label.

    Args:
        label: in a log's words.

    Returns:
        The category; the label itself where it is one of nuScenes already, or none of them fits.

    >>> find_category("Pickup Truck"), find_category("vehicle.emergency.police"), find_category("Hovercraft")
    ('vehicle.truck', 'vehicle.emergency.police', 'Hovercraft')
    """
    is_category = label.startswith(("vehicle.", "human.", "movable_object.", "static_object."))
    return label if is_category else find_class(label, NUSCENES_CATEGORIES, label)


def find_attribute(category: str, speed_m_s: float) -> str:
    """Tells whether an object moves.

    Args:
        category: of nuScenes.
        speed_m_s: of the object.

    Returns:
        The attribute; empty for categories that have another kind of them, or none.

    >>> find_attribute("vehicle.car", 3.0), find_attribute("vehicle.bicycle", 3.0)
    ('vehicle.moving', '')
    """
    moves = speed_m_s > _MOVING_M_S
    if category.startswith("human.pedestrian"):
        return "pedestrian.moving" if moves else "pedestrian.standing"
    # What has a rider or not, its velocity does not tell.
    if category.startswith("vehicle.") and category not in ("vehicle.bicycle", "vehicle.motorcycle"):
        return "vehicle.moving" if moves else "vehicle.parked"
    return ""


class NuScenesTables:
    """Rows of all tables; tokens follow from scene, channel, frame and track."""

    def __init__(self) -> None:
        self._rows: dict[str, dict[str, dict[str, Any]]] = {name: {} for name in _TABLES}
        # Frames by scene and channel, for the links from one image to the next.
        self._frames: dict[tuple[str, str], list[int]] = {}
        for level, (low, high) in _VISIBILITIES.items():
            text = f"{low} to {high} % of the object are visible"
            self._rows["visibility"][level] = {"token": level, "level": f"v{low}-{high}", "description": text}
        for name in ATTRIBUTES:
            self._add("attribute", token("attribute", name), name=name, description=name.replace(".", ": "))

    def _add(self, table: str, key: str, **columns: Any) -> str:
        self._rows[table].setdefault(key, {"token": key, **columns})
        return key

    def add_calibrated_sensor(
        self, scene: str, channel: str, vehicle_SE3_camera: Float64, camera_intrinsic: list[list[float]]
    ) -> None:
        """Adds a camera of a scene.

        Args:
            scene: its name.
            channel: the camera.
            vehicle_SE3_camera: [4, 4].
            camera_intrinsic: [3][3] pixels, from the centre of the first one.
        """
        sensor = self._add("sensor", token("sensor", channel), channel=channel, modality="camera")
        key = token("calibrated_sensor", scene, channel)
        pose = _describe_pose(vehicle_SE3_camera)
        self._add("calibrated_sensor", key, sensor_token=sensor, **pose, camera_intrinsic=camera_intrinsic)

    def add_image(
        self,
        scene: str,
        channel: str,
        frame: int,
        time_us: int,
        world_SE3_vehicle: Float64,
        filename: str,
        size_px: tuple[int, int],
    ) -> None:
        """Adds an image.

        Args:
            scene: its name.
            channel: the camera, which has been added.
            frame: of the log.
            time_us: microseconds since 1970.
            world_SE3_vehicle: [4, 4] at that time.
            filename: below the root.
            size_px: width and height.
        """
        key = token("sample_data", scene, channel, frame)
        pose = token("ego_pose", scene, channel, frame)
        self._add("ego_pose", pose, timestamp=time_us, **_describe_pose(world_SE3_vehicle))
        self._frames.setdefault((scene, channel), []).append(frame)
        self._add(
            "sample_data",
            key,
            sample_token=token("sample", scene, frame),
            ego_pose_token=pose,
            calibrated_sensor_token=token("calibrated_sensor", scene, channel),
            timestamp=time_us,
            fileformat="png",
            is_key_frame=True,
            height=size_px[1],
            width=size_px[0],
            filename=filename,
        )

    def add_scene(self, scene: str, log: str, frames: Sequence[int], times_us: Sequence[int]) -> None:
        """Adds a scene with its samples.

        Args:
            scene: its name.
            log: name of the log.
            frames: of the log, rising.
            times_us: of the frames, microseconds since 1970.
        """
        date = datetime.fromtimestamp(times_us[0] / 1_000_000, UTC).date().isoformat()
        where = {"vehicle": "unknown", "location": "unknown"}
        log_key = self._add("log", token("log", log), logfile=log, date_captured=date, **where)
        keys = [token("sample", scene, frame) for frame in frames]
        scene_key = self._add(
            "scene",
            token("scene", scene),
            log_token=log_key,
            nbr_samples=len(frames),
            first_sample_token=keys[0],
            last_sample_token=keys[-1],
            name=scene,
            description=scene,
        )
        for k, (key, time_us) in enumerate(zip(keys, times_us, strict=True)):
            links = _neighbours(keys, k)
            self._add("sample", key, timestamp=time_us, scene_token=scene_key, **links)

    def add_instance(self, scene: str, track_id: str, category: str, frames: Sequence[int]) -> None:
        """Adds an object of a scene.

        Args:
            scene: its name.
            track_id: the log's name for the object.
            category: of nuScenes.
            frames: in which it has a box, rising.
        """
        self._add("category", token("category", category), name=category, description=category, index=0)
        self._add(
            "instance",
            token("instance", scene, track_id),
            category_token=token("category", category),
            nbr_annotations=len(frames),
            first_annotation_token=token("annotation", scene, track_id, frames[0]),
            last_annotation_token=token("annotation", scene, track_id, frames[-1]),
        )

    def add_annotation(
        self,
        scene: str,
        track_id: str,
        frame: int,
        frames: Sequence[int],
        world_SE3_box: Float64,
        facts: dict[str, Any],
    ) -> None:
        """Adds a box.

        Args:
            scene: its name.
            track_id: of an object that has been added.
            frame: of the log.
            frames: all frames in which the object has a box, rising.
            world_SE3_box: [4, 4].
            facts: the columns that do not follow from these.
        """
        keys = [token("annotation", scene, track_id, other) for other in frames]
        links = _neighbours(keys, frames.index(frame))
        self._add(
            "sample_annotation",
            token("annotation", scene, track_id, frame),
            sample_token=token("sample", scene, frame),
            instance_token=token("instance", scene, track_id),
            **_describe_pose(world_SE3_box),
            **facts,
            **links,
        )

    def write(self, root: Path) -> None:
        """Writes the tables, and the blank map that readers of nuScenes ask for.

        Args:
            root: folder that holds ``samples``.
        """
        for (scene, channel), frames in self._frames.items():
            keys = [token("sample_data", scene, channel, frame) for frame in sorted(frames)]
            for k, key in enumerate(keys):
                self._rows["sample_data"][key] |= _neighbours(keys, k)
        for number, row in enumerate(self._rows["category"].values()):
            row["index"] = number
        blank = "maps/blank.png"
        write_image(root / blank, np.zeros((16, 16, 3), np.uint8))
        logs = list(self._rows["log"])
        self._add("map", token("map", blank), log_tokens=logs, category="semantic_prior", filename=blank)
        for name, rows in self._rows.items():
            write_json(root / VERSION / f"{name}.json", list(rows.values()))


def _neighbours(keys: Sequence[str], k: int) -> dict[str, str]:
    """Links to the rows before and after; empty at the ends, as nuScenes has it."""
    return {"prev": keys[k - 1] if k else "", "next": keys[k + 1] if k + 1 < len(keys) else ""}


def _describe_pose(pose: Float64) -> dict[str, list[float]]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = (float(value) for value in Rotation.from_matrix(pose[:3, :3]).as_quat())
    return {"translation": [float(value) for value in pose[:3, 3]], "rotation": [w, x, y, z]}
