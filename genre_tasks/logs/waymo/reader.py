"""Reader of the Waymo Open Dataset, version 2: ``waymo:PATH/SEGMENT``."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from genre_tasks.logs.box_validity import StatedBox, find_bad_boxes, report_bad_boxes
from genre_tasks.logs.file_digest import digest_files
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.labelled_boxes import MAX_BOXES, LabelledBox
from genre_tasks.logs.recorded_log import RecordedLog
from genre_tasks.logs.types import Camera, CuboidTrack, Float32, Float64, Sweep, Truth
from genre_tasks.logs.waymo.camera_rows import name_sensors, read_cameras
from genre_tasks.logs.waymo.component_tables import ComponentTable
from genre_tasks.logs.waymo.range_images import LidarCalibration, compute_points
from genre_tasks.logs.waymo.segment_address import COMPONENTS, find_component_files

LIDAR_NAMES = {1: "TOP", 2: "FRONT", 3: "SIDE_LEFT", 4: "SIDE_RIGHT", 5: "REAR"}
BOX_LABELS = {0: "unknown", 1: "vehicle", 2: "pedestrian", 3: "sign", 4: "cyclist"}

_US = 1e-6
_LASER = "key.laser_name"
_OBJECT = "key.laser_object_id"
_CENTRE = ("box.center.x", "box.center.y", "box.center.z")
_HEADING = "box.heading"
_SIZE = ("box.size.x", "box.size.y", "box.size.z")
_RETURNS = ("range_image_return1", "range_image_return2")
# Ten times the pixels of the upper LiDAR.
_MAX_PIXELS = 2_000_000
_UPPER = "TOP"


def open_waymo(rest: str) -> WaymoLog:
    """Opens a segment.

    Args:
        rest: ``PATH/SEGMENT``; PATH holds a folder for each component, and each of them ``SEGMENT.parquet``.

    Returns:
        The log.

    Raises:
        InputError: no such segment, a component is missing, or its table is malformed.
    """
    segment, files = find_component_files(rest)
    return WaymoLog(f"waymo:{rest}", segment, files)


class WaymoLog(RecordedLog):
    """A ``DrivingLog`` over a segment; see ``DrivingLog`` for methods, units and axes.

    Images and range images are read row by row when they are asked for. The world is the dataset's, whose origin may
    be kilometres away.

    Args:
        uri: what the user wrote.
        segment: its name.
        files: component → Parquet file.

    Raises:
        InputError: poses or cameras cannot be read.
    """

    dataset = "waymo"
    truth: Truth | None = None

    def __init__(self, uri: str, segment: str, files: dict[str, Path]) -> None:
        super().__init__(uri)
        self.name = re.sub(r"[^\w.=,+-]", "_", segment, flags=re.ASCII)
        self._files = files
        self._tables = {name: ComponentTable(path, COMPONENTS[name], uri) for name, path in files.items()}
        poses = self._tables["vehicle_pose"]
        # Rows of a component may stand in any order.
        order = np.argsort(poses.times_us, kind="stable")
        self._times_us = [poses.times_us[index] for index in order.tolist()]
        self.frame_count = len(self._times_us)
        if not self.frame_count or (np.diff(self._times_us) <= 0).any():
            raise poses.fault("there are no frames, or two of the same time")
        self._poses = poses.read_poses("world_from_vehicle.transform")[order]
        self._cameras = read_cameras(self._tables["camera_calibration"], self._tables["camera_image"])
        self._report(*self._cameras.findings)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras that have images, in the dataset's order."""
        return self._cameras.cameras

    def frame_timestamp_s(self, frame: int) -> float:
        """See ``DrivingLog``."""
        return self._times_us[self._check_frame(frame)] * _US

    def world_SE3_lidar(self, frame: int) -> Float64:
        """See ``DrivingLog``: the vehicle's own frame, in whose axes boxes are."""
        pose: Float64 = self._poses[self._check_frame(frame)].copy()
        return pose

    def _image(self, camera: str, frame: int) -> Any:
        self._check_camera_among(self._cameras.images, camera, frame)
        return self._cameras.images[camera].get(self._times_us[self._check_frame(frame)])

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """See ``DrivingLog``; at the time of the frame where it has no image."""
        image = self._image(camera, frame)
        vehicle = self._poses[frame] if image is None else image.world_SE3_vehicle
        pose: Float64 = vehicle @ self._cameras.vehicle_SE3_camera[camera]
        return pose

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """See ``DrivingLog``; the frame's time where it has no image."""
        image = self._image(camera, frame)
        return self.frame_timestamp_s(frame) if image is None else float(image.time_s)

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """See ``DrivingLog``."""
        image = self._image(camera, frame)
        if image is None:
            return None
        table = self._tables["camera_image"]
        value = table.read_row(image.row, ["image"], frame).get("image")
        data = None if value is None else value.as_py()
        if data is not None and not isinstance(data, bytes):
            raise table.fault("the column of images holds no bytes", frame=frame)
        # An empty value is a missing image.
        return data or None

    def sweep(self, frame: int) -> Sweep | None:
        """See ``DrivingLog``: all LiDARs and both returns; times of points are not stated and are the frame's.

        Raises:
            InputError: no such frame, or a range image that cannot be read.
        """
        rows = self._sweep_rows.get(self._times_us[self._check_frame(frame)])
        if not rows:
            return None
        parts = [part for name, row in sorted(rows.items()) for part in self._read_lidar(name, row, frame)]
        points = np.concatenate([points for points, _ in parts] or [np.zeros((0, 3))])
        intensity = np.concatenate([values for _, values in parts] or [np.zeros(0, np.float32)])
        placed = self._find_placed(points, frame)
        intensity = self._fill_intensities(intensity[placed], frame)
        return Sweep(
            points_world=points[placed],
            # A few surfaces return a thousand times more light than others.
            intensity=np.tanh(np.maximum(intensity, 0.0)).astype(np.float32),
            timestamps_s=np.full(len(intensity), self.frame_timestamp_s(frame)),
            sensor_world=self._find_upper(frame) if _UPPER in rows else None,
        )

    def _find_upper(self, frame: int) -> Float64:
        """[3] where the upper LiDAR is, which measures most of the points."""
        pose: Float64 = self._poses[frame] @ self._calibrations[_UPPER].vehicle_SE3_lidar
        return pose[:3, 3]

    @cached_property
    def _sweep_rows(self) -> dict[int, dict[str, int]]:
        """Time of the frame → LiDAR → row."""
        return self._index_rows("lidar") if "lidar" in self._tables else {}

    @cached_property
    def _pose_rows(self) -> dict[int, dict[str, int]]:
        return self._index_rows("lidar_pose") if "lidar_pose" in self._tables else {}

    def _index_rows(self, component: str) -> dict[int, dict[str, int]]:
        table = self._tables[component]
        found: dict[int, dict[str, int]] = {}
        for row, name in enumerate(name_sensors(table.read([_LASER], names=[_LASER])[_LASER], LIDAR_NAMES)):
            found.setdefault(table.times_us[row], {})[name] = row
        return found

    # When first asked for: a segment without sweeps needs none.
    @cached_property
    def _calibrations(self) -> dict[str, LidarCalibration]:
        if "lidar_calibration" not in self._tables:
            raise self._tables["lidar"].fault("there are range images without lidar_calibration")
        table = self._tables["lidar_calibration"]
        columns = table.read([_LASER, "beam_inclination.min", "beam_inclination.max"], names=[_LASER])
        mounts = table.read_poses("extrinsic.transform")
        found = {}
        for row, name in enumerate(name_sensors(columns[_LASER], LIDAR_NAMES)):
            stated = table.read_row(row, ["beam_inclination.values"], 0).get("beam_inclination.values")
            values = _read_list(table, stated, 0)
            lowest, highest = (float(columns[f"beam_inclination.{end}"][row]) for end in ("min", "max"))
            found[name] = LidarCalibration(
                mounts[row], np.zeros(0) if values is None else values.astype(np.float64), lowest, highest
            )
        return found

    def _read_lidar(self, name: str, row: int, frame: int) -> list[tuple[Float64, Float32]]:
        """Points and intensities of each return of a LiDAR."""
        table = self._tables["lidar"]
        if name not in self._calibrations:
            raise table.fault(f"there is no calibration of the LiDAR {name}", frame=frame)
        pixel_poses = self._read_pixel_poses(name, frame)
        images = [_read_tensor(table, row, field, 4, frame) for field in _RETURNS]
        try:
            return [
                compute_points(image, self._calibrations[name], self._poses[frame], pixel_poses)
                for image in images
                if image is not None
            ]
        except ValueError as error:
            raise table.fault(f"{name}: {error}", frame=frame) from error

    def _read_pixel_poses(self, name: str, frame: int) -> Float32 | None:
        row = self._pose_rows.get(self._times_us[frame], {}).get(name)
        if row is not None:
            return _read_tensor(self._tables["lidar_pose"], row, _RETURNS[0], 6, frame)
        if name == _UPPER:
            message = "the upper LiDAR has no poses of pixels: points are placed by the frame's pose"
            self._report(Finding("no_pixel_poses", "warning", message, "Download the component lidar_pose."))
        return None

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """See ``DrivingLog``.

        Raises:
            InputError: there are boxes, and they cannot be read, or all are bad.
        """
        return self._tracks

    @cached_property
    def _tracks(self) -> tuple[CuboidTrack, ...]:
        # Segments of the test split have none.
        if "lidar_box" not in self._tables:
            return ()
        table = self._tables["lidar_box"]
        if table.row_count > MAX_BOXES:
            raise table.fault(f"there are {table.row_count} boxes, and {MAX_BOXES} are allowed")
        return self._build_tracks(self._read_boxes(table), self.world_SE3_lidar)

    def _read_boxes(self, table: ComponentTable) -> list[LabelledBox]:
        numbers = (_HEADING, *_CENTRE, *_SIZE)
        columns = table.read([_OBJECT, "type", *numbers], names=[_OBJECT], unchecked=numbers)
        frames = {time_us: frame for frame, time_us in enumerate(self._times_us)}
        for time_us in table.times_us:
            if time_us not in frames:
                raise table.fault(f"a box is of {time_us} µs, where there is no frame")

        def locate(row: int) -> StatedBox:
            label = BOX_LABELS.get(int(columns["type"][row]), BOX_LABELS[0])
            source = f"{table.path.parent.name}/{table.path.name}, row {row}"
            return StatedBox(frames[table.times_us[row]], str(columns[_OBJECT][row]), label, source)

        centres, sizes, headings = (
            np.stack([columns[field] for field in fields], axis=1) for fields in (_CENTRE, _SIZE, (_HEADING,))
        )
        problems = find_bad_boxes(centres, sizes, angles_rad=headings)
        self._report(*report_bad_boxes(problems, len(sizes), locate, file=table.path, log=self.uri))
        boxes = []
        for row in range(len(sizes)):
            if row in problems:
                continue
            cos, sin = np.cos(columns[_HEADING][row]), np.sin(columns[_HEADING][row])
            pose = np.eye(4)
            pose[:2, :2] = [[cos, -sin], [sin, cos]]
            pose[:3, 3] = centres[row]
            stated = locate(row)
            length, width, height = sizes[row].tolist()
            boxes.append(LabelledBox(stated.frame, stated.track_id, stated.label, pose, (length, width, height)))
        return boxes

    def findings(self) -> tuple[Finding, ...]:
        """What is not modelled or was left out, for ``genre check``."""
        # Boxes first, which add to the findings.
        tracks = self._tracks
        found = tuple(self._findings.values())
        if not tracks:
            message = "there are no boxes, as in the test split"
            remedy = "Without boxes, whatever moves is smeared over its path."
            found += (Finding("no_labels", "note", message, remedy),)
        return found

    def digest(self) -> str:
        """Identifies the files of all components that are read."""
        # Files of all components have the same name.
        root = self._files["vehicle_pose"].parent.parent
        return digest_files(root, self._files.values(), ())


def _read_tensor(table: ComponentTable, row: int, field: str, channels: int, frame: int) -> Float32 | None:
    """[H, W, channels] of a range image; ``None`` where there is none."""
    values = table.read_row(row, [f"{field}.values", f"{field}.shape"], frame)
    numbers, shape = (values.get(f"{field}.{part}") for part in ("values", "shape"))
    array = _read_list(table, numbers, frame)
    stated = _read_list(table, shape, frame)
    if array is None or stated is None:
        return None
    height, width, depth = (
        (int(side) for side in stated) if len(stated) == 3 and stated.dtype.kind == "i" else (0, 0, 0)
    )
    # Numbers and shape are columns of their own, which may differ.
    is_shape = min(height, width) > 0 and depth == channels and height * width <= _MAX_PIXELS
    if not is_shape or len(array) != height * width * depth:
        problem = f"a range image of {len(array)} numbers has the shape {stated[:4].tolist()}"
        raise table.fault(problem, frame=frame)
    image: Float32 = array.astype(np.float32).reshape(height, width, depth)
    return image


def _read_list(table: ComponentTable, value: Any, frame: int) -> Any:
    """[N] numbers of a list of Arrow; ``None`` where it is missing."""
    if value is None or not value.is_valid:
        return None
    is_list = pa.types.is_list(value.type) or pa.types.is_fixed_size_list(value.type)
    kind = value.type.value_type if is_list else None
    if kind is None or not (pa.types.is_floating(kind) or pa.types.is_integer(kind)) or value.values.null_count:
        raise table.fault(f"a list of numbers is {value.type}, or has nulls", frame=frame)
    return value.values.to_numpy(zero_copy_only=False)
