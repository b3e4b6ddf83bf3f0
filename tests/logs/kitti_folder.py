"""Any driving log whose cameras look the same way, written in KITTI's layout with a rig of its own."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import Camera, CuboidTrack, DrivingLog

Float64 = NDArray[np.float64]

START_S = 1_317_042_504
DRIVE = "2011_09_26/2011_09_26_drive_0001_sync"
_EARTH_RADIUS_M = 6378137.0
_ORIGIN = np.radians([49.0, 8.4])
# Where the sensors are on the vehicle is of no account, as long as the files agree.
_VELODYNE_SE3_IMU = np.eye(4)
_VELODYNE_SE3_IMU[:3, :3] = Rotation.from_euler("ZYX", [0.01, -0.02, 0.015]).as_matrix()
_VELODYNE_SE3_IMU[:3, 3] = -0.8, 0.3, -0.8
_RECTIFICATION = Rotation.from_euler("ZYX", [0.01, 0.007, -0.004]).as_matrix()


def write_kitti(log: DrivingLog, folder: Path, with_tracklets: bool = True, camera_count: int | None = None) -> Path:
    """The folder of the drive; the first cameras become image_02, image_03."""
    drive = folder / DRIVE
    cameras = log.cameras[:camera_count]
    _write_calibration(log, cameras, drive.parent)
    frames = range(log.frame_count)
    lidar_times = [log.frame_timestamp_s(frame) for frame in frames]
    _write_times(drive / "velodyne_points", lidar_times)
    _write_times(drive / "oxts", lidar_times)
    (drive / "velodyne_points/data").mkdir()
    (drive / "oxts/data").mkdir()
    origin = log.world_SE3_lidar(0) @ _VELODYNE_SE3_IMU
    for frame in frames:
        world_SE3_imu = log.world_SE3_lidar(frame) @ _VELODYNE_SE3_IMU
        _write_pose(drive / f"oxts/data/{frame:010d}.txt", world_SE3_imu, origin)
        sweep = log.sweep(frame)
        if sweep is not None:
            local = (sweep.points_world - log.world_SE3_lidar(frame)[:3, 3]) @ log.world_SE3_lidar(frame)[:3, :3]
            rows = np.column_stack([local, sweep.intensity]).astype("<f4")
            (drive / f"velodyne_points/data/{frame:010d}.bin").write_bytes(rows.tobytes())
    for number, camera in enumerate(cameras):
        name = f"image_{number + 2:02d}"
        _write_times(drive / name, [log.camera_timestamp_s(camera.name, frame) for frame in frames])
        (drive / name / "data").mkdir()
        for frame in frames:
            image = log.image_bytes(camera.name, frame)
            if image is not None:
                (drive / name / f"data/{frame:010d}.png").write_bytes(image)
    if with_tracklets:
        (drive / "tracklet_labels.xml").write_text(_format_tracklets(log), encoding="utf-8")
    return drive


def shifted_world(log: DrivingLog) -> Float64:
    """[4, 4] that takes the log's world to the drive's, whose origin is the inertial unit at the first frame."""
    shift = np.eye(4)
    shift[:3, 3] = -(log.world_SE3_lidar(0) @ _VELODYNE_SE3_IMU)[:3, 3]
    return shift


def write_tracking_labels(log: DrivingLog, path: Path) -> Path:
    """The boxes as the tracking benchmark has them, with a region that is not labelled."""
    lines = ["0 -1 DontCare -1 -1 -10.0 1.0 1.0 2.0 2.0 -1000 -1000 -1000 -10 -1 -1 -1"]
    for number, track in enumerate(log.tracks()):
        for frame, box in zip(track.frames, track.world_SE3_box, strict=True):
            camera = log.cameras[0].name
            local = np.linalg.inv(log.world_SE3_camera(camera, int(frame))) @ box
            turn = np.arctan2(-local[2, 0], local[0, 0])
            length, width, height = track.size_m
            x, y, z = local[:3, 3] + [0.0, height / 2, 0.0]
            numbers = [height, width, length, x, y, z, turn]
            lines.append(f"{frame} {number} {track.label} 0 0 0.0 1 1 2 2 " + " ".join(map(repr, map(float, numbers))))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _write_calibration(log: DrivingLog, cameras: tuple[Camera, ...], day: Path) -> None:
    day.mkdir(parents=True)
    first = cameras[0]
    lidar_SE3_first = np.linalg.inv(log.world_SE3_lidar(0)) @ log.world_SE3_camera(first.name, 0)
    rectification = np.eye(4)
    rectification[:3, :3] = _RECTIFICATION
    # The first grey camera stands where the first camera is, turned by what its rectification turns back.
    camera_SE3_velodyne = np.linalg.inv(rectification) @ np.linalg.inv(lidar_SE3_first)
    lines = [f"R_rect_00: {_join(_RECTIFICATION)}"]
    for number, camera in enumerate(cameras):
        lens = camera.lens
        first_SE3_camera = np.linalg.inv(log.world_SE3_camera(first.name, 0)) @ log.world_SE3_camera(camera.name, 0)
        assert np.allclose(first_SE3_camera[:3, :3], np.eye(3))
        matrix = np.array([[lens.fx_px, 0, lens.cx_px - 0.5], [0, lens.fy_px, lens.cy_px - 0.5], [0, 0, 1]])
        projection = np.column_stack([matrix, -matrix @ first_SE3_camera[:3, 3]])
        lines.append(f"S_rect_{number + 2:02d}: {lens.width_px:.6e} {lens.height_px:.6e}")
        lines.append(f"P_rect_{number + 2:02d}: {_join(projection)}")
    (day / "calib_cam_to_cam.txt").write_text("calib_time: 09-Jan-2012 13:57:47\n" + "\n".join(lines) + "\n")
    for name, matrix in (("velo_to_cam", camera_SE3_velodyne), ("imu_to_velo", _VELODYNE_SE3_IMU)):
        text = f"calib_time: 15-Mar-2012 11:37:16\nR: {_join(matrix[:3, :3])}\nT: {_join(matrix[:3, 3])}\n"
        (day / f"calib_{name}.txt").write_text(text)


def _join(values: Float64) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values).ravel())


def _write_times(folder: Path, times_s: list[float]) -> None:
    folder.mkdir(parents=True)
    lines = []
    for time_s in times_s:
        nanoseconds = round(time_s * 1e9)
        second = datetime.fromtimestamp(START_S + nanoseconds // 10**9, UTC)
        lines.append(f"{second:%Y-%m-%d %H:%M:%S}.{nanoseconds % 10**9:09d}\n")
    (folder / "timestamps.txt").write_text("".join(lines))


def _write_pose(path: Path, world_SE3_imu: Float64, origin: Float64) -> None:
    east, north, up = world_SE3_imu[:3, 3] - origin[:3, 3]
    scale = np.cos(_ORIGIN[0]) * _EARTH_RADIUS_M
    start = np.log(np.tan(np.pi / 4 + _ORIGIN[0] / 2))
    latitude = 2 * np.arctan(np.exp(start + north / scale)) - np.pi / 2
    longitude = _ORIGIN[1] + east / scale
    yaw, pitch, roll = Rotation.from_matrix(world_SE3_imu[:3, :3]).as_euler("ZYX")
    numbers = [np.degrees(latitude), np.degrees(longitude), 114.0 + up, roll, pitch, yaw, *[0.0] * 24]
    path.write_text(_join(np.array(numbers)) + "\n")


def _format_tracklets(log: DrivingLog) -> str:
    items = "".join(_format_tracklet(log, track) for track in log.tracks())
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<!DOCTYPE boost_serialization>\n'
    body = f"<tracklets><count>{len(log.tracks())}</count><item_version>1</item_version>{items}</tracklets>"
    return f'{head}<boost_serialization signature="serialization::archive">{body}</boost_serialization>\n'


def _format_tracklet(log: DrivingLog, track: CuboidTrack) -> str:
    length, width, height = track.size_m
    # A tracklet has every frame between its first and its last.
    assert (np.diff(track.frames) == 1).all()
    poses = []
    for frame, box in zip(track.frames, track.world_SE3_box, strict=True):
        local = np.linalg.inv(log.world_SE3_lidar(int(frame))) @ box
        yaw, pitch, roll = Rotation.from_matrix(local[:3, :3]).as_euler("ZYX")
        x, y, z = local[:3, 3] - local[:3, :3] @ [0.0, 0.0, height / 2]
        names = ("tx", "ty", "tz", "rx", "ry", "rz")
        fields = zip(names, (x, y, z, roll, pitch, yaw), strict=True)
        poses.append("<item>" + "".join(f"<{k}>{float(v)!r}</{k}>" for k, v in fields) + "</item>")
    sizes = f"<h>{height!r}</h><w>{width!r}</w><l>{length!r}</l><first_frame>{track.frames[0]}</first_frame>"
    return f"<item><objectType>{escape(track.label)}</objectType>{sizes}<poses>{''.join(poses)}</poses></item>"
