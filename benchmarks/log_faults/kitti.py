"""KITTI raw as a driving log, so that the PandaSet writer can put it in the layout that the product reads."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np

from benchmarks.common.bench import NotMeasuredError
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Lens, Sweep, Truth
from genre_tasks.scene.image_decoding import read_image_size
from genre_tasks.scene.transforms import compose_se3, invert_se3

_EARTH_RADIUS_M = 6378137.0
# The colour cameras; KITTI numbers its four cameras from 0.
_CAMERAS = {"front_camera": "02", "front_right_camera": "03"}


class KittiLog:
    """A ``DrivingLog`` over a drive of KITTI raw; without cuboids, which KITTI keeps apart.

    Sweeps are placed by the pose at their frame's time, as most converters do: within a sweep the motion of the vehicle
    is not compensated.

    Args:
        drive: the folder ``…/2011_09_26_drive_0009_sync``; the calibration lies above it.

    Raises:
        NotMeasuredError: there is no such folder.
    """

    dataset = "kitti"
    truth: Truth | None = None

    def __init__(self, drive: Path) -> None:
        if not (drive / "oxts/data").is_dir():
            raise NotMeasuredError(f"there is no KITTI drive {drive}; give it with --set kitti=PATH")
        self._drive = drive
        self.uri = f"kitti:{drive}"
        self.name = drive.name
        self.frame_count = len(list((drive / "oxts/data").glob("*.txt")))
        self._camera_calibration = _read_calibration(drive.parent / "calib_cam_to_cam.txt")

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The two colour cameras."""
        cameras = []
        for name, number in _CAMERAS.items():
            projection = self._camera_calibration[f"P_rect_{number}"].reshape(3, 4)
            size = read_image_size(self.image_bytes(name, 0))
            # KITTI counts from the centre of the first pixel.
            lens = Lens(
                fx_px=float(projection[0, 0]),
                fy_px=float(projection[1, 1]),
                cx_px=float(projection[0, 2]) + 0.5,
                cy_px=float(projection[1, 2]) + 0.5,
                width_px=size[0],
                height_px=size[1],
            )
            cameras.append(Camera(name, lens))
        return tuple(cameras)

    @cached_property
    def _world_SE3_lidar(self) -> Float64:
        """[F, 4, 4], with the origin at the first position of the inertial unit."""
        rows = np.stack([np.loadtxt(path) for path in sorted((self._drive / "oxts/data").glob("*.txt"))])
        world_SE3_imu = _poses_from_oxts(rows)
        # Near the origin, as PandaSet's are.
        world_SE3_imu[:, :3, 3] -= world_SE3_imu[0, :3, 3]
        lidar_SE3_imu = _read_transform(self._drive.parent / "calib_imu_to_velo.txt")
        poses: Float64 = world_SE3_imu @ invert_se3(lidar_SE3_imu)
        return poses

    @cached_property
    def _lidar_SE3_camera(self) -> dict[str, Float64]:
        camera0_SE3_lidar = _read_transform(self._drive.parent / "calib_velo_to_cam.txt")
        rectified_SE3_camera0 = compose_se3(self._camera_calibration["R_rect_00"].reshape(3, 3), np.zeros(3))
        poses = {}
        for name, number in _CAMERAS.items():
            projection = self._camera_calibration[f"P_rect_{number}"].reshape(3, 4)
            offset = np.asarray(np.linalg.solve(projection[:, :3], projection[:, 3]), dtype=np.float64)
            camera_SE3_lidar = compose_se3(np.eye(3), offset) @ rectified_SE3_camera0 @ camera0_SE3_lidar
            poses[name] = invert_se3(camera_SE3_lidar)
        return poses

    @cached_property
    def _times_s(self) -> dict[str, list[float]]:
        folders = {"lidar": "velodyne_points"} | {name: f"image_{number}" for name, number in _CAMERAS.items()}
        return {key: _read_times(self._drive / folder / "timestamps.txt") for key, folder in folders.items()}

    def frame_timestamp_s(self, frame: int) -> float:
        """See ``DrivingLog``."""
        return self._times_s["lidar"][frame]

    def world_SE3_lidar(self, frame: int) -> Float64:
        """See ``DrivingLog``."""
        return self._world_SE3_lidar[frame].copy()

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """See ``DrivingLog``."""
        pose: Float64 = self._world_SE3_lidar[frame] @ self._lidar_SE3_camera[camera]
        return pose

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """See ``DrivingLog``."""
        return self._times_s[camera][frame]

    def image_bytes(self, camera: str, frame: int) -> bytes:
        """See ``DrivingLog``."""
        return (self._drive / f"image_{_CAMERAS[camera]}/data/{frame:010d}.png").read_bytes()

    def sweep(self, frame: int) -> Sweep:
        """See ``DrivingLog``."""
        path = self._drive / f"velodyne_points/data/{frame:010d}.bin"
        rows = np.fromfile(path, dtype=np.float32).reshape(-1, 4).astype(np.float64)
        pose = self._world_SE3_lidar[frame]
        points = rows[:, :3] @ pose[:3, :3].T + pose[:3, 3]
        return Sweep(points, rows[:, 3].astype(np.float32), np.full(len(rows), self.frame_timestamp_s(frame)))

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """None: KITTI keeps its boxes in a benchmark of their own."""
        return ()

    def digest(self) -> str:
        """Identifies the drive by its name: it is not changed."""
        return hashlib.sha256(self.uri.encode()).hexdigest()


def _read_calibration(path: Path) -> dict[str, Float64]:
    """Key → numbers, of the lines that hold numbers."""
    lines = (line.partition(":") for line in path.read_text(encoding="utf-8").splitlines())
    return {key: np.array(text.split(), dtype=np.float64) for key, _, text in lines if key and key != "calib_time"}


def _read_transform(path: Path) -> Float64:
    entries = _read_calibration(path)
    return compose_se3(entries["R"].reshape(3, 3), entries["T"])


def _read_times(path: Path) -> list[float]:
    times = []
    for line in path.read_text(encoding="utf-8").split("\n"):
        if not line.strip():
            continue
        # Nanoseconds, of which Python reads six digits.
        moment = datetime.fromisoformat(line.strip()[:26]).replace(tzinfo=UTC)
        times.append(moment.timestamp())
    return times


def _poses_from_oxts(rows: Float64) -> Float64:
    """[F, 4, 4] of the inertial unit from latitude, longitude, altitude, roll, pitch, yaw, as KITTI's tools."""
    from scipy.spatial.transform import Rotation

    # One scale for the drive, so that distances along it are metres.
    scale = np.cos(np.deg2rad(rows[0, 0]))
    x = scale * _EARTH_RADIUS_M * np.deg2rad(rows[:, 1])
    y = scale * _EARTH_RADIUS_M * np.log(np.tan(np.deg2rad(90 + rows[:, 0]) / 2))
    rotation = Rotation.from_euler("ZYX", rows[:, [5, 4, 3]]).as_matrix()
    return compose_se3(rotation, np.stack([x, y, rows[:, 2]], axis=1))
