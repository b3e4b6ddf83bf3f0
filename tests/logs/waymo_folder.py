"""Any driving log in the layout of Waymo's version 2: a Parquet file for each component, times in microseconds."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import DrivingLog
from genre_tasks.logs.waymo.segment_address import COMPONENTS

Float64 = NDArray[np.float64]
START_US = 1_552_440_195_000_000
SEGMENT = "10023947602400723454_1120_000_1140_000"
# Waymo has no camera that looks back.
CAMERAS = {"front": 1, "front_left": 2, "front_right": 3, "left": 4, "right": 5, "back": 6}
NAMES = {"front": "FRONT", "left": "SIDE_LEFT", "right": "SIDE_RIGHT", "back": "SENSOR_6"}
# The LiDAR is turned on the roof.
LIDAR_MOUNT = np.eye(4)
LIDAR_MOUNT[:3, :3] = Rotation.from_euler("ZYX", [2.4, 0.01, -0.02]).as_matrix()
LIDAR_MOUNT[:3, 3] = 1.43, 0.0, 2.18
INCLINATIONS = np.linspace(-0.31, 0.04, 8)
# Axes x forward, y left, z up in those of x right, y down, z forward.
CAMERA_SE3_WAYMO = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
LISTS = pa.list_(pa.float32())
TRANSFORM = pa.list_(pa.float64(), 16)


def write_waymo(log: DrivingLog, root: Path, segment: str = SEGMENT, rows_in_group: int = 3) -> str:
    """What follows ``waymo:`` for the segment.

    Every point gets a pixel, whose pose turns the pixel's direction to the point's.
    """
    frames = range(log.frame_count)
    times = [to_us(log.frame_timestamp_s(frame)) for frame in frames]
    poses = [log.world_SE3_lidar(frame) for frame in frames]
    write = _Writer(root, segment, rows_in_group)
    write("vehicle_pose", times, {}, {"world_from_vehicle.transform": flatten(poses)})
    _write_cameras(log, write)
    sweeps = [(time_us, frame) for frame, time_us in enumerate(times) if log.sweep(frame) is not None]
    lasers = {"key.laser_name": pa.array([1] * len(sweeps), pa.int8())}
    images = [make_range_image(log, frame) for _, frame in sweeps]
    if sweeps:
        rows = [time_us for time_us, _ in sweeps]
        columns = {"range_image_return1": [image for image, _ in images]}
        write("lidar", rows, lasers, tensors(columns) | tensors({"range_image_return2": [None] * len(rows)}))
        write("lidar_pose", rows, lasers, tensors({"range_image_return1": [pose for _, pose in images]}))
        write("lidar_calibration", None, {"key.laser_name": pa.array([1], pa.int8())}, calibrate(INCLINATIONS))
    boxes = [(times[frame], track, np.linalg.inv(poses[frame]) @ box) for frame, track, box in _list_boxes(log)]
    if boxes:
        keys = {"key.laser_object_id": pa.array([track.track_id for _, track, _ in boxes])}
        values: dict[str, Any] = {"type": pa.array([1] * len(boxes), pa.int8())}
        values["box.heading"] = [np.arctan2(box[1, 0], box[0, 0]) for _, _, box in boxes]
        for k, axis in enumerate("xyz"):
            values[f"box.center.{axis}"] = [box[k, 3] for _, _, box in boxes]
            values[f"box.size.{axis}"] = [track.size_m[k] for _, track, _ in boxes]
        write("lidar_box", [time_us for time_us, _, _ in boxes], keys, values)
    return f"{root}/{segment}"


def to_us(time_s: float) -> int:
    """Since the start of the tests' clock."""
    return START_US + round(time_s * 1e6)


def flatten(poses: list[Float64]) -> pa.Array:
    """Poses as the dataset has them."""
    return pa.array([pose.ravel().tolist() for pose in poses], TRANSFORM)


def tensors(columns: dict[str, list[Any]]) -> dict[str, pa.Array]:
    """Range images as lists of numbers and shapes."""
    found = {}
    for name, images in columns.items():
        values = [None if image is None else image.ravel() for image in images]
        shapes = [None if image is None else list(image.shape) for image in images]
        found[f"{name}.values"] = pa.array(values, LISTS)
        found[f"{name}.shape"] = pa.array(shapes, pa.list_(pa.int32(), 3))
    return found


def calibrate(inclinations: Float64, mount: Float64 = LIDAR_MOUNT) -> dict[str, Any]:
    """Columns of the calibration of one LiDAR."""
    values = {"beam_inclination.min": [float(inclinations[0])], "beam_inclination.max": [float(inclinations[-1])]}
    lists = pa.array([inclinations.tolist()], pa.list_(pa.float64()))
    return {"extrinsic.transform": flatten([mount]), **values, "beam_inclination.values": lists}


def make_range_image(log: DrivingLog, frame: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """[H, W, 4] range image and [H, W, 6] poses of its pixels."""
    sweep = log.sweep(frame)
    assert sweep is not None
    pose = log.world_SE3_lidar(frame)
    local = (sweep.points_world - pose[:3, 3]) @ pose[:3, :3]
    height = len(INCLINATIONS)
    width = -(-len(local) // height) + 1
    rows, columns = np.divmod(np.arange(len(local)), width)
    ranges = np.linalg.norm(local, axis=1)
    image = np.full((height, width, 4), -1.0, np.float32)
    image[rows, columns] = np.stack([ranges, np.arctanh(sweep.intensity), 0 * ranges, 0 * ranges], axis=1)
    azimuths = ((width - columns - 0.5) / width * 2 - 1) * np.pi - np.arctan2(LIDAR_MOUNT[1, 0], LIDAR_MOUNT[0, 0])
    nominal = Rotation.from_euler("ZY", np.stack([azimuths, -INCLINATIONS[::-1][rows]], axis=1))
    wanted_angles = np.stack([np.arctan2(local[:, 1], local[:, 0]), -np.arcsin(local[:, 2] / ranges)], axis=1)
    turns = Rotation.from_euler("ZY", wanted_angles) * nominal.inv()
    mount = np.linalg.inv(LIDAR_MOUNT)
    rotations = Rotation.from_matrix(pose[:3, :3]) * turns
    vehicle = rotations * Rotation.from_matrix(mount[:3, :3])
    poses = np.zeros((height, width, 6), np.float32)
    poses[rows, columns, :3] = vehicle.as_euler("ZYX")[:, ::-1]
    poses[rows, columns, 3:] = rotations.apply(mount[:3, 3]) + pose[:3, 3]
    return image, poses


class _Writer:
    def __init__(self, root: Path, segment: str, rows_in_group: int) -> None:
        self._root = root
        self._segment = segment
        self._rows_in_group = rows_in_group

    def __call__(self, component: str, times: list[int] | None, keys: dict[str, Any], values: dict[str, Any]) -> None:
        """A file; without times it is one of the whole segment."""
        columns = dict(keys)
        if times is not None:
            columns["key.frame_timestamp_micros"] = pa.array(times, pa.int64())
        columns |= {f"[{COMPONENTS[component]}].{name}": column for name, column in values.items()}
        count = len(next(iter(columns.values())))
        path = self._root / component / f"{self._segment}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        table = pa.table({"key.segment_context_name": [self._segment] * count, **columns})
        pq.write_table(table, path, row_group_size=self._rows_in_group, write_page_checksum=True)


def change_column(root: Path, component: str, field: str, values: Any, segment: str = SEGMENT) -> None:
    """Puts other values into a column; ``None`` removes it."""
    path = root / component / f"{segment}.parquet"
    table = pq.read_table(path)
    name = field if field.startswith("key.") else f"[{COMPONENTS[component]}].{field}"
    index = table.column_names.index(name)
    table = table.remove_column(index)
    if values is not None:
        table = table.add_column(index, name, values if isinstance(values, pa.Array) else pa.array(values))
    pq.write_table(table, path)


def _write_cameras(log: DrivingLog, write: _Writer) -> None:
    cameras = list(log.cameras)
    mounts = {c.name: np.linalg.inv(log.world_SE3_lidar(0)) @ log.world_SE3_camera(c.name, 0) for c in cameras}
    lenses = [camera.lens for camera in cameras]
    keys = {"key.camera_name": _number(camera.name for camera in cameras)}
    values: dict[str, Any] = {
        "intrinsic.f_u": [lens.fx_px for lens in lenses],
        "intrinsic.f_v": [lens.fy_px for lens in lenses],
        "intrinsic.c_u": [lens.cx_px for lens in lenses],
        "intrinsic.c_v": [lens.cy_px for lens in lenses],
        "width": pa.array([lens.width_px for lens in lenses], pa.int32()),
        "height": pa.array([lens.height_px for lens in lenses], pa.int32()),
        "rolling_shutter_direction": pa.array([5] * len(lenses), pa.int8()),
        "extrinsic.transform": flatten([mounts[camera.name] @ CAMERA_SE3_WAYMO for camera in cameras]),
    }
    for k, name in enumerate(("k1", "k2", "p1", "p2", "k3")):
        values[f"intrinsic.{name}"] = [lens.coefficients[k] for lens in lenses]
    write("camera_calibration", None, keys, values)
    rows = [(c.name, f) for f in range(log.frame_count) for c in cameras if log.image_bytes(c.name, f) is not None]
    keys = {"key.camera_name": _number(name for name, _ in rows)}
    fired = np.array([START_US * 1e-6 + log.camera_timestamp_s(name, frame) for name, frame in rows])
    poses = [log.world_SE3_camera(name, frame) @ np.linalg.inv(mounts[name]) for name, frame in rows]
    images: dict[str, Any] = {"image": pa.array([log.image_bytes(name, frame) for name, frame in rows], pa.binary())}
    images |= {"pose.transform": flatten(poses), "pose_timestamp": fired}
    for axis in "xyz":
        images[f"velocity.linear_velocity.{axis}"] = pa.array([0.0] * len(rows), pa.float32())
        images[f"velocity.angular_velocity.{axis}"] = [0.0] * len(rows)
    images["rolling_shutter_params.shutter"] = [0.0] * len(rows)
    images["rolling_shutter_params.camera_trigger_time"] = fired
    images["rolling_shutter_params.camera_readout_done_time"] = fired
    times = [to_us(log.frame_timestamp_s(frame)) for _, frame in rows]
    write("camera_image", times, keys, images)


def _number(cameras: Iterable[str]) -> pa.Array:
    return pa.array([CAMERAS[name.removesuffix("_camera")] for name in cameras], pa.int8())


def _list_boxes(log: DrivingLog) -> list[tuple[int, Any, Float64]]:
    pairs = [(track, index) for track in log.tracks() for index in range(len(track.frames))]
    return [(int(track.frames[index]), track, track.world_SE3_box[index]) for track, index in pairs]
