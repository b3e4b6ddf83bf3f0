"""Small valid logs in the layouts of other datasets, of two frames and one camera: what damages begin with."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fuzz.fuzz_samples import encode_pictures

START_S = 1_532_402_927
DRIVE = "2011_09_26/2011_09_26_drive_0001_sync"
SEGMENT = "1002"

_QUAT = ("qw", "qx", "qy", "qz")
_SHIFT = ("tx_m", "ty_m", "tz_m")


def write_kitti_folder(root: Path) -> None:
    """Writes a drive of KITTI with tracklets and labels."""
    image, drive = _picture(), root / DRIVE
    numbers = " ".join
    eye = "1 0 0 0 1 0 0 0 1"
    lens = "P_rect_02: 40 0 24 0 0 40 16 0 0 0 1 0\n"
    _write(drive.parent / "calib_cam_to_cam.txt", f"calib_time: 09-Jan-2012 13:57:47\nR_rect_00: {eye}\n{lens}")
    for name in ("velo_to_cam", "imu_to_velo"):
        _write(drive.parent / f"calib_{name}.txt", f"R: {eye}\nT: 0.1 0.2 0.3\n")
    for sensor in ("oxts", "velodyne_points", "image_02"):
        for name in ("timestamps", "timestamps_start", "timestamps_end"):
            _write(drive / sensor / f"{name}.txt", "".join(f"2011-09-26 13:02:2{k}.{k}50000000\n" for k in (1, 2)))
    for frame in (0, 1):
        pose = [49.0 + 1e-5 * frame, 8.4, 114.0, 0.01, 0.02, 0.3, *[0.0] * 24]
        _write(drive / f"oxts/data/{frame:010d}.txt", numbers(map(repr, pose)))
        _write(drive / f"velodyne_points/data/{frame:010d}.bin", _points(4).tobytes())
        _write(drive / f"image_02/data/{frame:010d}.png", image)
    place = "".join(f"<{name}>{k}.5</{name}>" for k, name in enumerate(("tx", "ty", "tz", "rx", "ry", "rz")))
    item = f"<objectType>Car</objectType><h>1.5</h><w>1.8</w><l>4.0</l><first_frame>0</first_frame><poses><item>{place}"
    text = f"<boost><tracklets><count>1</count><item>{item}</item></poses></item></tracklets></boost>"
    _write(drive / "tracklet_labels.xml", text)
    _write(root / "labels.txt", "0 -1 DontCare -1 -1 -10 1 1 2 2 -1000 -1000 -1000 -10 -1 -1 -1\n" + _LABELS)


_LABELS = "0 7 Car 0 0 0.0 1 1 2 2 1.5 1.8 4.0 2.5 1.0 9.5 0.1\n1 7 Car 0 0 0.0 1 1 2 2 1.5 1.8 4.0 2.5 1.0 9.0 0.1\n"


def write_argoverse2_folder(root: Path) -> None:
    """Writes a log of Argoverse 2."""
    times = [START_S * 10**9, START_S * 10**9 + 10**8]
    poses = {name: [float(name == "qw")] * 2 for name in _QUAT} | {name: [5000.0, 5001.0] for name in _SHIFT}
    names = ["up_lidar", "ring_front"]
    lens = {"fx_px": 40.0, "fy_px": 40.0, "cx_px": 24.0, "cy_px": 16.0, "width_px": 48, "height_px": 32}
    boxes = {"timestamp_ns": times, "track_uuid": ["a", "a"], "category": ["CAR"] * 2, **poses}
    sizes = {name: [4.0, 4.0] for name in ("length_m", "width_m", "height_m")}
    columns = dict(zip("xyz", _points(3).T, strict=True))
    sweep = {**columns, "intensity": np.full(6, 9, np.uint8), "offset_ns": np.zeros(6, np.int32)}
    _write(root / "city_SE3_egovehicle.feather", make_feather({"timestamp_ns": times, **poses}))
    _write(root / "calibration/egovehicle_SE3_sensor.feather", make_feather({"sensor_name": names, **poses}))
    intrinsics = {"sensor_name": ["ring_front"], **{name: [value] for name, value in lens.items()}}
    _write(root / "calibration/intrinsics.feather", make_feather(intrinsics))
    _write(root / "annotations.feather", make_feather({**boxes, **sizes}))
    for time in times:
        _write(root / f"sensors/lidar/{time}.feather", make_feather(sweep))
        _write(root / f"sensors/cameras/ring_front/{time}.png", _picture())


def make_feather(columns: dict[str, Any]) -> bytes:
    """Writes a table as Feather."""
    import pyarrow as pa
    from pyarrow import feather

    sink = io.BytesIO()
    feather.write_feather(pa.table(columns), sink)
    return sink.getvalue()


def write_nuscenes_folder(root: Path) -> None:
    """Writes a scene of nuScenes of two key frames."""
    pose = {"translation": [1.0, 2.0, 0.0], "rotation": [0.8, 0.0, 0.0, 0.6]}
    matrix = [[40.0, 0.0, 24.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]]
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": "scene", "name": "scene-0061"}],
        "sensor": [
            {"token": "lidar", "channel": "LIDAR_TOP", "modality": "lidar"},
            {"token": "camera", "channel": "CAM_FRONT", "modality": "camera"},
        ],
        "calibrated_sensor": [
            {"token": "on-lidar", "sensor_token": "lidar", "camera_intrinsic": [], **pose},
            {"token": "on-camera", "sensor_token": "camera", "camera_intrinsic": matrix, **pose},
        ],
        "category": [{"token": "car", "name": "vehicle.car"}],
        "instance": [{"token": "object", "category_token": "car"}],
        "sample": [],
        "sample_data": [],
        "ego_pose": [],
        "sample_annotation": [],
    }
    for frame in (0, 1):
        sample = f"sample-{frame}"
        time = {"timestamp": START_S * 10**6 + frame * 500_000}
        tables["sample"].append({"token": sample, "scene_token": "scene", **time})
        box = {"token": f"box-{frame}", "sample_token": sample, "instance_token": "object", "size": [1.8, 4.0, 1.5]}
        tables["sample_annotation"].append({**box, **pose})
        for sensor, file in (("lidar", f"{frame}.pcd.bin"), ("camera", f"{frame}.png")):
            token = f"{sensor}-{frame}"
            tables["ego_pose"].append({"token": token, **time, **pose})
            links = {"sample_token": sample, "ego_pose_token": token, "calibrated_sensor_token": f"on-{sensor}"}
            datum = {"token": token, **links, **time, "filename": f"samples/{file}", "is_key_frame": True}
            tables["sample_data"].append({**datum, "width": 48, "height": 32})
        _write(root / f"samples/{frame}.pcd.bin", _points(5).tobytes())
        _write(root / f"samples/{frame}.png", _picture())
    for name, rows in tables.items():
        _write(root / f"v1.0-mini/{name}.json", json.dumps(rows, indent=1))


def write_waymo_folder(root: Path) -> None:
    """Writes a segment of Waymo's version 2 with one LiDAR."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    from genre_tasks.logs.waymo.segment_address import COMPONENTS

    times = [START_S * 10**6, START_S * 10**6 + 100_000]
    poses = pa.array([np.eye(4).ravel().tolist()] * 2, pa.list_(pa.float64(), 16))
    lens = {f"intrinsic.{name}": [40.0] for name in ("f_u", "f_v")} | {"intrinsic.c_u": [24.0], "intrinsic.c_v": [16.0]}
    lens |= {f"intrinsic.{name}": [0.0] for name in ("k1", "k2", "p1", "p2", "k3")}
    shutter = {"shutter": 0.004, "camera_trigger_time": START_S - 0.01, "camera_readout_done_time": START_S + 0.03}
    speeds = {f"velocity.{kind}_velocity.{axis}": [0.5] * 2 for kind in ("linear", "angular") for axis in "xyz"}
    sizes = {f"box.{part}.{axis}": [4.0, 4.0] for part in ("center", "size") for axis in "xyz"}
    camera, laser = {"key.camera_name": pa.array([1], pa.int8())}, {"key.laser_name": pa.array([1], pa.int8())}
    components: dict[str, dict[str, Any]] = {
        "vehicle_pose": {"world_from_vehicle.transform": poses},
        "camera_calibration": {
            **{**camera, **lens, "width": [48], "height": [32], "rolling_shutter_direction": [1]},
            "extrinsic.transform": poses[:1],
        },
        "camera_image": {
            **{"key.camera_name": pa.array([1, 1], pa.int8()), "image": [_picture()] * 2, "pose.transform": poses},
            **{"pose_timestamp": [START_S, START_S + 0.1], **speeds},
            **{f"rolling_shutter_params.{name}": [value, value + 0.1] for name, value in shutter.items()},
        },
        "lidar": {"key.laser_name": pa.array([1, 1], pa.int8()), **_range_images(1, 4), **_range_images(2, 4)},
        "lidar_calibration": {
            **{**laser, "beam_inclination.min": [-0.3], "beam_inclination.max": [0.1]},
            **{"beam_inclination.values": [[-0.3, 0.1]], "extrinsic.transform": poses[:1]},
        },
        "lidar_pose": {"key.laser_name": pa.array([1, 1], pa.int8()), **_range_images(1, 6)},
        "lidar_box": {"key.laser_object_id": ["a", "a"], "type": [1, 1], "box.heading": [0.1, 0.2], **sizes},
    }
    for name, values in components.items():
        columns = {
            (field if field.startswith("key.") else f"[{COMPONENTS[name]}].{field}"): values[field] for field in values
        }
        if len(next(iter(values.values()))) == len(times):
            columns["key.frame_timestamp_micros"] = times
        (root / name).mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(columns), root / name / f"{SEGMENT}.parquet")


def _range_images(number: int, channels: int) -> dict[str, Any]:
    import pyarrow as pa

    # Two beams of three columns.
    values = np.random.default_rng(channels).uniform(1, 9, (2, 2 * 3 * channels)).astype(np.float32)
    shapes = pa.array([[2, 3, channels]] * 2, pa.list_(pa.int32(), 3))
    name = f"range_image_return{number}"
    return {f"{name}.values": pa.array(list(values), pa.list_(pa.float32())), f"{name}.shape": shapes}


def _points(columns: int) -> Any:
    return np.random.default_rng(columns).uniform(1, 9, (6, columns)).astype("<f4")


def _picture() -> bytes:
    return encode_pictures("PNG")[0]


def _write(path: Path, content: str | bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
