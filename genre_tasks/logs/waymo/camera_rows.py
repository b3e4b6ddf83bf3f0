"""Images and cameras of a segment: lenses, poses at the time of an image, and the readout of the shutter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.logs.camera_names import require_camera_names
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.lens_validity import with_distortion
from genre_tasks.logs.types import Camera, Float64, Lens
from genre_tasks.logs.waymo.component_tables import ComponentTable

CAMERA_NAMES = {1: "FRONT", 2: "FRONT_LEFT", 3: "FRONT_RIGHT", 4: "SIDE_LEFT", 5: "SIDE_RIGHT"}

_NAME = "key.camera_name"
_TOP_TO_BOTTOM = 1
_OTHER_DIRECTIONS = {2: "from left to right", 3: "from bottom to top", 4: "from right to left"}
_INTRINSICS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
_VELOCITY = tuple(f"velocity.{kind}_velocity.{axis}" for kind in ("linear", "angular") for axis in "xyz")
_SHUTTER = tuple(
    f"rolling_shutter_params.{name}" for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")
)
# An image is exposed and read within a frame.
_MAX_READOUT_S = 0.1
# Metres and radians a second.
_MAX_VELOCITY = 1e3
# Axes x right, y down, z forward in those of Waymo's cameras: x forward, y left, z up.
_WAYMO_SE3_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class ImageRow:
    """An image.

    Attributes:
        row: of the table.
        time_s: the middle of the exposure of the middle of the image, since 1970.
        world_SE3_vehicle: [4, 4] at that time.
    """

    row: int
    time_s: float
    world_SE3_vehicle: Float64


@dataclass(frozen=True)
class SegmentCameras:
    """The cameras of a segment.

    Attributes:
        cameras: in the order of their numbers.
        vehicle_SE3_camera: camera → [4, 4].
        images: camera → time of the frame in microseconds → image.
        findings: shutters that are not modelled.
    """

    cameras: tuple[Camera, ...]
    vehicle_SE3_camera: dict[str, Float64]
    images: dict[str, dict[int, ImageRow]]
    findings: tuple[Finding, ...]


def read_cameras(calibration: ComponentTable, images: ComponentTable) -> SegmentCameras:
    """Reads cameras and the times and poses of images; images themselves are not read.

    Args:
        calibration: component ``camera_calibration``.
        images: component ``camera_image``.

    Returns:
        Cameras that have a calibration and images.

    Raises:
        InputError: a table lacks columns, or holds what no camera has, such as a name that leads out of a folder.
    """
    # Cameras that took no image of this segment are left out.
    rows, readouts = _read_images(images)
    fields = [f"intrinsic.{name}" for name in _INTRINSICS]
    columns = calibration.read([_NAME, *fields, "width", "height", "rolling_shutter_direction"], names=[_NAME])
    mounts = calibration.read_poses("extrinsic.transform")
    cameras: list[Camera] = []
    findings: list[Finding] = []
    poses = {}
    for index, name in sorted(
        enumerate(name_sensors(columns[_NAME], CAMERA_NAMES)), key=lambda pair: columns[_NAME][pair[0]]
    ):
        if name not in rows:
            continue
        if name in poses:
            raise calibration.fault(f"the camera {name} has two calibrations")
        direction = int(columns["rolling_shutter_direction"][index])
        exposure_s, readout_s = readouts[name]
        if direction in _OTHER_DIRECTIONS and readout_s > 0:
            findings.append(_describe_readout(name, _OTHER_DIRECTIONS[direction], readout_s))
        numbers = [float(columns[field][index]) for field in fields]
        size = (int(columns["width"][index]), int(columns["height"][index]))
        lens = _build_lens(numbers, size, calibration, name)
        cameras.append(Camera(name, lens, readout_s if direction == _TOP_TO_BOTTOM else 0.0, exposure_s))
        poses[name] = mounts[index] @ _WAYMO_SE3_CAMERA
    # A pair of files of two segments would look like this.
    if not cameras:
        raise calibration.fault("no camera has both a calibration and images")
    require_camera_names(poses, log=calibration.log, file=calibration.path)
    return SegmentCameras(tuple(cameras), poses, {name: rows[name] for name in poses}, tuple(findings))


def name_sensors(keys: Any, names: dict[int, str]) -> list[str]:
    """Names sensors.

    Args:
        keys: [N] numbers of the dataset, or names.
        names: number → name.

    Returns:
        [N] names; a number that is not known becomes ``SENSOR_`` and the number.
    """
    if isinstance(keys, list):
        return [str(key) for key in keys]
    return [names.get(key, f"SENSOR_{key}") for key in np.asarray(keys).astype(np.int64).tolist()]


def _build_lens(numbers: list[float], size: tuple[int, int], calibration: ComponentTable, name: str) -> Lens:
    fx_px, fy_px, cx_px, cy_px, *distortion = numbers
    if not (fx_px > 0 and fy_px > 0 and min(size) > 0):
        raise calibration.fault(f"{name} has no positive focal length and size")
    # Waymo counts from the left edge of the first pixel, as this project does.
    lens = Lens(fx_px, fy_px, cx_px, cy_px, *size)
    where = {"file": calibration.path, "log": calibration.log, "camera": name}
    return with_distortion(lens, {"distortion": distortion if any(distortion) else None}, **where)


def _describe_readout(name: str, direction: str, readout_s: float) -> Finding:
    message = f"{name} is read out {direction} in {1000 * readout_s:.0f} ms, which is not modelled"
    remedy = "The pose holds for the middle of the image."
    return Finding("unmodelled_readout", "note", message, remedy, {"readout_s": readout_s}, name)


def _read_images(images: ComponentTable) -> tuple[dict[str, dict[int, ImageRow]], dict[str, tuple[float, float]]]:
    """Camera → time of the frame → image, and camera → exposure and readout in seconds."""
    columns = images.read([_NAME, "pose_timestamp", *_VELOCITY, *_SHUTTER], names=[_NAME])
    poses = images.read_poses("pose.transform")
    shutter_s, trigger_s, done_s = (columns[field] for field in _SHUTTER)
    # Exposure of the first column begins at the trigger, and that of the last one ends before it is read.
    spans_s = done_s - trigger_s
    is_stated = (spans_s > 0) & (spans_s < _MAX_READOUT_S) & (shutter_s >= 0) & (shutter_s <= spans_s)
    middles_s = np.where(is_stated, trigger_s + spans_s / 2, columns["pose_timestamp"])
    is_near = np.abs(middles_s - columns["pose_timestamp"]) < _MAX_READOUT_S
    middles_s = np.where(is_near, middles_s, columns["pose_timestamp"])
    velocity = np.stack([columns[field] for field in _VELOCITY], axis=1)
    if np.abs(velocity).max(initial=0.0) > _MAX_VELOCITY:
        raise images.fault("a velocity is out of all proportion")
    moved = _move_poses(poses, velocity, middles_s - columns["pose_timestamp"])
    rows: dict[str, dict[int, ImageRow]] = {}
    times: dict[str, list[int]] = {}
    for row, name in enumerate(name_sensors(columns[_NAME], CAMERA_NAMES)):
        time_us = images.times_us[row]
        if time_us in rows.setdefault(name, {}):
            raise images.fault(f"{name} has two images of the frame at {time_us} µs")
        rows[name][time_us] = ImageRow(row, float(middles_s[row]), moved[row])
        if is_stated[row]:
            times.setdefault(name, []).append(row)
    readouts = dict.fromkeys(rows, (0.0, 0.0))
    for name, stated in times.items():
        exposure_s = float(np.median(shutter_s[stated]))
        readouts[name] = (exposure_s, float(np.median(spans_s[stated] - shutter_s[stated])))
    return rows, readouts


def _move_poses(poses: Float64, velocity: Float64, seconds: Float64) -> Float64:
    """[N, 4, 4] poses some milliseconds later, by linear and angular velocities in the world."""
    if not len(poses):
        return poses
    moved = poses.copy()
    turns = Rotation.from_rotvec(velocity[:, 3:] * seconds[:, None]).as_matrix()
    moved[:, :3, :3] = turns @ poses[:, :3, :3]
    moved[:, :3, 3] += velocity[:, :3] * seconds[:, None]
    return moved
