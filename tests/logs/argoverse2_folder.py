"""Any driving log in the layout of Argoverse 2: cameras become ring_NAME, times are whole nanoseconds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import feather
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import DrivingLog

START_NS = 315_966_265_000_000_000
# The city's origin is far away.
CITY_OFFSET_M = np.array([5172.5, 2419.25, 66.5])


def write_argoverse2(log: DrivingLog, folder: Path, point_type: Any = np.float32) -> Path:
    """The folder of the log."""
    frames = range(log.frame_count)
    poses: dict[int, NDArray[np.float64]] = {}
    for frame in frames:
        poses[to_ns(log.frame_timestamp_s(frame))] = log.world_SE3_lidar(frame)
    mounts = {"up_lidar": np.eye(4)}
    for camera in log.cameras:
        mounts[f"ring_{camera.name}"] = np.linalg.inv(log.world_SE3_lidar(0)) @ log.world_SE3_camera(camera.name, 0)
        path = folder / f"sensors/cameras/ring_{camera.name}"
        path.mkdir(parents=True)
        for frame in frames:
            image = log.image_bytes(camera.name, frame)
            if image is not None:
                (path / f"{to_ns(log.camera_timestamp_s(camera.name, frame))}.png").write_bytes(image)
    (folder / "sensors/lidar").mkdir(parents=True)
    for frame in frames:
        sweep = log.sweep(frame)
        if sweep is None:
            continue
        pose = log.world_SE3_lidar(frame)
        local = ((sweep.points_world - pose[:3, 3]) @ pose[:3, :3]).astype(point_type)
        time_ns = to_ns(log.frame_timestamp_s(frame))
        columns = {name: local[:, k] for k, name in enumerate("xyz")}
        columns["intensity"] = np.round(sweep.intensity * 255).astype(np.uint8)
        offsets = [to_ns(time_s) - time_ns for time_s in sweep.timestamps_s.tolist()]
        columns["offset_ns"] = np.array(offsets, dtype=np.int32)
        _write(folder / f"sensors/lidar/{time_ns}.feather", columns)
    shifted = {time_ns: _shift(pose) for time_ns, pose in poses.items()}
    _write(folder / "city_SE3_egovehicle.feather", {"timestamp_ns": list(shifted), **_describe(list(shifted.values()))})
    _write_calibration(log, folder, mounts)
    rows = [
        (to_ns(log.frame_timestamp_s(int(frame))), track, np.linalg.inv(log.world_SE3_lidar(int(frame))) @ box)
        for track in log.tracks()
        for frame, box in zip(track.frames, track.world_SE3_box, strict=True)
    ]
    boxes: dict[str, Any] = {"timestamp_ns": [time_ns for time_ns, _, _ in rows]}
    boxes |= {"track_uuid": [track.track_id for _, track, _ in rows], "category": [t.label for _, t, _ in rows]}
    boxes |= {f"{side}_m": [t.size_m[k] for _, t, _ in rows] for k, side in enumerate(("length", "width", "height"))}
    if rows:
        _write(folder / "annotations.feather", {**boxes, **_describe([box for _, _, box in rows])})
    return folder


def to_ns(time_s: float) -> int:
    """Since the start of the tests' clock."""
    return START_NS + round(time_s * 1e9)


def _shift(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    shifted = pose.copy()
    shifted[:3, 3] += CITY_OFFSET_M
    return shifted


def _write_calibration(log: DrivingLog, folder: Path, mounts: dict[str, NDArray[np.float64]]) -> None:
    (folder / "calibration").mkdir()
    columns = {"sensor_name": list(mounts), **_describe(list(mounts.values()))}
    _write(folder / "calibration/egovehicle_SE3_sensor.feather", columns)
    lenses = [camera.lens for camera in log.cameras]
    columns = {
        "sensor_name": [f"ring_{camera.name}" for camera in log.cameras],
        "fx_px": [lens.fx_px for lens in lenses],
        "fy_px": [lens.fy_px for lens in lenses],
        "cx_px": [lens.cx_px - 0.5 for lens in lenses],
        "cy_px": [lens.cy_px - 0.5 for lens in lenses],
        "k1": [-0.24] * len(lenses),
        "width_px": np.array([lens.width_px for lens in lenses], np.uint16),
        "height_px": np.array([lens.height_px for lens in lenses], np.uint16),
    }
    _write(folder / "calibration/intrinsics.feather", columns)


def _describe(poses: list[NDArray[np.float64]]) -> dict[str, Any]:
    matrices = np.array(poses)
    quats = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
    columns = {name: quats[:, k] for name, k in (("qw", 3), ("qx", 0), ("qy", 1), ("qz", 2))}
    return columns | {f"t{axis}_m": matrices[:, k, 3].copy() for k, axis in enumerate("xyz")}


def _write(path: Path, columns: dict[str, Any]) -> None:
    feather.write_feather(pa.table(columns), path)
