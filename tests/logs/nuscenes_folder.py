"""Any driving log in the layout of nuScenes: cameras become CAM_NAME, times are whole microseconds."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import DrivingLog

Float64 = NDArray[np.float64]
START_US = 1_532_402_927_000_000
# The LiDAR's y points ahead, as in the real rig.
LIDAR_MOUNT = np.eye(4)
LIDAR_MOUNT[:3, :3] = Rotation.from_euler("ZYX", [-1.57, 0.01, -0.02]).as_matrix()
LIDAR_MOUNT[:3, 3] = 0.94, 0.0, 1.84
VERSION = "v1.0-mini"


def write_nuscenes(
    log: DrivingLog, root: Path, scene: str = "scene-0061", key_every: int = 1, version: str = VERSION
) -> str:
    """What follows ``nuscenes:`` for the scene; every n-th frame is a key frame and has boxes.

    Where an image is missing there is no row in odd frames, and no file in even ones.
    """
    tables = _Tables(root, scene, key_every)
    tables.add_frames(log)
    tables.add_boxes(log)
    tables.save(root / version)
    return f"{root}/{scene}"


def token(*parts: object) -> str:
    """Thirty-two hexadecimal digits."""
    return hashlib.md5(repr(parts).encode()).hexdigest()


def to_us(time_s: float) -> int:
    """Since the start of the tests' clock."""
    return START_US + round(time_s * 1e6)


def change_table(root: Path, name: str, change: Callable[[list[dict[str, Any]]], Any], version: str = VERSION) -> None:
    """Rewrites a table; ``change`` returns other rows, or ``None`` where it changed them in place."""
    path = root / version / f"{name}.json"
    rows = json.loads(path.read_text())
    changed = change(rows)
    path.write_text(json.dumps(rows if changed is None else changed, indent=0))


class _Tables:
    def __init__(self, root: Path, scene: str, key_every: int) -> None:
        self.root = root
        self.scene = scene
        self.key_every = key_every
        names = ("scene", "sample", "sensor", "calibrated_sensor", "sample_data", "ego_pose", "category", "instance")
        self.rows: dict[str, list[dict[str, Any]]] = {name: [] for name in (*names, "sample_annotation")}
        self.add("scene", token(scene), name=scene, description="")

    def add(self, table: str, key: str, **values: Any) -> str:
        """A row of a table."""
        self.rows[table].append({"token": key, **values})
        return key

    def add_frames(self, log: DrivingLog) -> None:
        """Samples, sensors, poses and files."""
        lidar = self._add_sensor("LIDAR_TOP", "lidar", LIDAR_MOUNT, [])
        self._add_sensor("RADAR_FRONT", "radar", np.eye(4), [])
        mounts = {}
        cameras = {}
        for camera in log.cameras:
            lens = camera.lens
            matrix = [[lens.fx_px, 0.0, lens.cx_px - 0.5], [0.0, lens.fy_px, lens.cy_px - 0.5], [0.0, 0.0, 1.0]]
            mounts[camera.name] = np.linalg.inv(log.world_SE3_lidar(0)) @ log.world_SE3_camera(camera.name, 0)
            cameras[camera.name] = self._add_sensor(_name(camera.name), "camera", mounts[camera.name], matrix)
        for frame in range(log.frame_count):
            is_key = frame % self.key_every == 0
            if is_key:
                time_us = to_us(log.frame_timestamp_s(frame))
                self.add("sample", self._sample(frame), scene_token=token(self.scene), timestamp=time_us)
            self._add_datum("LIDAR_TOP", lidar, frame, log.frame_timestamp_s(frame), log.world_SE3_lidar(frame))
            self._write_sweep(log, frame)
            self._add_datum("RADAR_FRONT", token(self.scene, "RADAR_FRONT"), frame, 0.0, np.eye(4))
            for camera in log.cameras:
                image = log.image_bytes(camera.name, frame)
                if image is None and frame % 2:
                    continue
                pose = log.world_SE3_camera(camera.name, frame) @ np.linalg.inv(mounts[camera.name])
                time_s = log.camera_timestamp_s(camera.name, frame)
                size = (camera.lens.width_px, camera.lens.height_px)
                self._add_datum(_name(camera.name), cameras[camera.name], frame, time_s, pose, size)
                if image is not None:
                    self._write(_name(camera.name), frame, image)

    def add_boxes(self, log: DrivingLog) -> None:
        """Instances and the boxes of key frames."""
        for label in sorted({track.label for track in log.tracks()}):
            self.add("category", token("category", label), name=label, description="")
        for track in log.tracks():
            instance = self.add("instance", token(track.track_id), category_token=token("category", track.label))
            length, width, height = track.size_m
            for frame, box in zip(track.frames.tolist(), track.world_SE3_box, strict=True):
                if frame % self.key_every:
                    continue
                key = token("box", track.track_id, frame)
                pose = _describe(box)
                sample = self._sample(frame)
                values = {"sample_token": sample, "instance_token": instance, "size": [width, length, height], **pose}
                self.add("sample_annotation", key, **values)

    def save(self, folder: Path) -> None:
        """The tables as files."""
        folder.mkdir(parents=True)
        for name, rows in self.rows.items():
            (folder / f"{name}.json").write_text(json.dumps(rows, indent=0))

    def _sample(self, frame: int) -> str:
        return token(self.scene, "sample", frame - frame % self.key_every)

    def _add_sensor(self, channel: str, modality: str, mount: Float64, matrix: list[list[float]]) -> str:
        sensor = self.add("sensor", token(channel), channel=channel, modality=modality)
        key = token(self.scene, channel)
        return self.add("calibrated_sensor", key, sensor_token=sensor, camera_intrinsic=matrix, **_describe(mount))

    def _file(self, channel: str, frame: int) -> str:
        folder = "sweeps" if frame % self.key_every else "samples"
        suffix = "pcd.bin" if channel == "LIDAR_TOP" else "jpg"
        return f"{folder}/{channel}/{self.scene}-{frame}.{suffix}"

    def _add_datum(
        self, channel: str, sensor: str, frame: int, time_s: float, pose: Float64, size: tuple[int, int] | None = None
    ) -> None:
        key = token(self.scene, channel, frame)
        time_us = to_us(time_s)
        self.add("ego_pose", token("pose", key), timestamp=time_us, **_describe(pose))
        links = {"ego_pose_token": token("pose", key), "calibrated_sensor_token": sensor}
        width, height = size or (None, None)
        self.add(
            "sample_data",
            key,
            sample_token=self._sample(frame),
            timestamp=time_us,
            filename=self._file(channel, frame),
            is_key_frame=frame % self.key_every == 0,
            width=width,
            height=height,
            **links,
        )

    def _write_sweep(self, log: DrivingLog, frame: int) -> None:
        sweep = log.sweep(frame)
        if sweep is None:
            return
        pose = log.world_SE3_lidar(frame) @ LIDAR_MOUNT
        local = (sweep.points_world - pose[:3, 3]) @ pose[:3, :3]
        rows = np.column_stack([local, sweep.intensity * 255.0, np.zeros(len(local))]).astype("<f4")
        self._write("LIDAR_TOP", frame, rows.tobytes())

    def _write(self, channel: str, frame: int, data: bytes) -> None:
        path = self.root / self._file(channel, frame)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def _name(camera: str) -> str:
    return f"CAM_{camera.upper()}"


def _describe(pose: Float64) -> dict[str, list[float]]:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return {"translation": pose[:3, 3].tolist(), "rotation": [w, x, y, z]}
