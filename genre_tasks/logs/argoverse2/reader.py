"""Reader of the Argoverse 2 sensor dataset: ``argoverse2:PATH/LOG``."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.argoverse2.feather_tables import POSITION, QUATERNION, compose_poses, read_columns
from genre_tasks.logs.box_validity import StatedBox, find_bad_boxes, report_bad_boxes
from genre_tasks.logs.camera_names import require_camera_names
from genre_tasks.logs.file_digest import digest_files
from genre_tasks.logs.file_reading import read_file
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.image_sizes import choose_lens, measure_images, report_problems
from genre_tasks.logs.labelled_boxes import MAX_BOXES, LabelledBox
from genre_tasks.logs.nearest_images import find_nearest_images
from genre_tasks.logs.point_values import fill_point_times
from genre_tasks.logs.recorded_log import RecordedLog
from genre_tasks.logs.timed_poses import POSE_REACH_S, TimedPoses
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Lens, Sweep, Truth
from genre_tasks.user_paths import expand_user_path

_POSES = "city_SE3_egovehicle.feather"
_MOUNTS = "calibration/egovehicle_SE3_sensor.feather"
_LENSES = "calibration/intrinsics.feather"
_BOXES = "annotations.feather"
_TIMED_FILE = re.compile(r"([0-9]{1,19})\.(?:jpg|png|feather)")
_REMEDY = "Give the folder of one log, as in argoverse2:PATH/7fab2350-7eaf-3b7e-a39d-6937a4c1bede."
_LENS_COLUMNS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
_SIZE_COLUMNS = ("length_m", "width_m", "height_m")
_POINT_COLUMNS = ("x", "y", "z", "intensity", "offset_ns")
# The grey stereo pair looks where the front camera of the ring does.
_RING = "ring_"
_INTENSITY_SCALE = 255.0
# Two LiDARs turn on the roof, one below the other by a hand's breadth.
_MAIN_LIDAR = "up_lidar"
_NS = 1e-9
# Without a neighbour, what a sweep's frame lasts: ten sweeps a second.
_PERIOD_NS = 100_000_000


def open_argoverse2(rest: str) -> Argoverse2Log:
    """Opens the folder of one log.

    Args:
        rest: path of the folder; ``~`` is the home folder.

    Returns:
        The log.

    Raises:
        InputError: no such log, or its poses or calibration cannot be read.
    """
    folder = expand_user_path(rest)
    uri = f"argoverse2:{rest}"
    if not rest or not (folder / _POSES).is_file():
        logs = sorted(path.parent.name for path in folder.glob(f"*/{_POSES}")) if rest else []
        hint = f" Logs in it: {', '.join(logs[:10])}." if logs else ""
        raise InputError(f"there is no {_POSES}", remedy=f"{_REMEDY}{hint}", file=folder, log=uri)
    return Argoverse2Log(uri, folder.resolve())


class Argoverse2Log(RecordedLog):
    """A ``DrivingLog`` over a log of Argoverse 2; see ``DrivingLog`` for methods, units and axes.

    A frame is a sweep; each camera gives its image that is nearest in time, with the pose of that time. Images are
    undistorted already, and all rows are taken at once. The world is the city's, moved to where the log begins.

    Args:
        uri: what the user wrote.
        folder: of the log.

    Raises:
        InputError: poses or calibration cannot be read, or there are no sweeps.
    """

    dataset = "argoverse2"
    truth: Truth | None = None

    def __init__(self, uri: str, folder: Path) -> None:
        super().__init__(uri)
        self.folder = folder
        self.name = re.sub(r"[^\w.=,+-]", "_", folder.name, flags=re.ASCII)
        self._sweeps = _list_timed_files(folder / "sensors/lidar")
        self._sweep_times_ns = np.array(sorted(self._sweeps), dtype=np.int64)
        self.frame_count = len(self._sweep_times_ns)
        if not self.frame_count:
            raise InputError("there are no sweeps", remedy=_REMEDY, file=folder / "sensors/lidar", log=uri)
        self._poses = self._read_poses()
        self._mounts = self._read_mounts()
        self._lenses = self._read_lenses()
        self._images = {name: _list_timed_files(folder / "sensors/cameras" / name) for name in self._lenses}

    def _read_poses(self) -> TimedPoses:
        path = self.folder / _POSES
        columns = read_columns(path, ("timestamp_ns", *QUATERNION, *POSITION), self.uri)
        # Several sensors may share a time.
        times_ns, rows = np.unique(columns["timestamp_ns"].astype(np.int64), return_index=True)
        if len(times_ns) < 2:
            raise InputError(f"{len(times_ns)} poses; two are needed", remedy=_REMEDY, file=path, log=self.uri)
        rotations, positions = compose_poses({name: values[rows] for name, values in columns.items()}, path, self.uri)
        # A city's origin may be kilometres away.
        start = positions[0]
        return TimedPoses(times_ns * _NS, rotations, positions - start, POSE_REACH_S, file=path, log=self.uri)

    def _read_mounts(self) -> dict[str, Float64]:
        """Sensor → [4, 4] vehicle_SE3_sensor."""
        path = self.folder / _MOUNTS
        columns = read_columns(path, (*QUATERNION, *POSITION), self.uri, texts=("sensor_name",))
        rotations, positions = compose_poses(columns, path, self.uri)
        poses = np.tile(np.eye(4), (len(positions), 1, 1))
        poses[:, :3, :3] = rotations.as_matrix()
        poses[:, :3, 3] = positions
        return dict(zip(columns["sensor_name"], poses, strict=True))

    def _read_lenses(self) -> dict[str, Lens]:
        """Camera → lens, of the ring's cameras that have a mount."""
        path = self.folder / _LENSES
        columns = read_columns(path, _LENS_COLUMNS, self.uri, texts=("sensor_name",))
        rows = np.stack([columns[name].astype(np.float64) for name in _LENS_COLUMNS], axis=1)
        lenses = {}
        for name, row in zip(columns["sensor_name"], rows.tolist(), strict=True):
            if not name.startswith(_RING):
                continue
            require_camera_names([name], log=self.uri, file=path)
            fx_px, fy_px, cx_px, cy_px, width_px, height_px = row
            if name not in self._mounts or not (fx_px > 0 and fy_px > 0 and width_px >= 1 and height_px >= 1):
                problem = f"{name} has no place on the vehicle, or no positive focal length and size"
                raise InputError(problem, remedy="Download the log again.", file=path, log=self.uri, camera=name)
            # Taken to count from the centre of the first pixel, as OpenCV's calibration does.
            lenses[name] = Lens(fx_px, fy_px, cx_px + 0.5, cy_px + 0.5, int(width_px), int(height_px))
        return lenses

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The ring's cameras that have images, in the order of the calibration."""
        cameras = []
        for name, lens in self._lenses.items():
            files = self._images[name]
            if not files:
                continue
            # Images that are nearest to no sweep are not read, and must not choose the size.
            nearest = enumerate(self._nearest[name])
            measured = measure_images({frame: files[time] for frame, time in nearest if time is not None})
            self._report(*report_problems(measured, name))
            lens, findings = choose_lens(lens, measured, name)
            self._report(*findings)
            cameras.append(Camera(name, lens))
        return tuple(cameras)

    @cached_property
    def _nearest(self) -> dict[str, list[int | None]]:
        """Camera → for each frame the time of its image, in ns."""
        return {name: self._find_nearest(sorted(files)) for name, files in self._images.items()}

    def _find_nearest(self, times_ns: list[int]) -> list[int | None]:
        nearest = find_nearest_images(self._sweep_times_ns.tolist(), times_ns, _PERIOD_NS)
        return [None if index is None else times_ns[index] for index in nearest]

    def frame_timestamp_s(self, frame: int) -> float:
        """See ``DrivingLog``."""
        return float(self._sweep_times_ns[self._check_frame(frame)] * _NS)

    def world_SE3_lidar(self, frame: int) -> Float64:
        """See ``DrivingLog``: the vehicle's own frame, in whose axes sweeps and boxes are."""
        return self._poses.matrix_at(self.frame_timestamp_s(frame), frame)

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """See ``DrivingLog``."""
        time_s = self.camera_timestamp_s(camera, frame)
        pose: Float64 = self._poses.matrix_at(time_s, frame) @ self._mounts[camera]
        return pose

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """See ``DrivingLog``; the sweep's time where a frame has no image."""
        self._check_camera(camera, frame)
        time_ns = self._nearest[camera][self._check_frame(frame)]
        return self.frame_timestamp_s(frame) if time_ns is None else time_ns * _NS

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """See ``DrivingLog``."""
        self._check_camera(camera, frame)
        time_ns = self._nearest[camera][self._check_frame(frame)]
        if time_ns is None:
            return None
        return read_file(self._images[camera][time_ns], log=self.uri, camera=camera, frame=frame)

    def sweep(self, frame: int) -> Sweep | None:
        """See ``DrivingLog``; both LiDARs, whose points the dataset has moved to the sweep's time already."""
        time_ns = int(self._sweep_times_ns[self._check_frame(frame)])
        path = self._sweeps[time_ns]
        try:
            columns = read_columns(path, (), self.uri, unchecked=_POINT_COLUMNS)
        except InputError as error:
            error.frame = frame
            raise
        local = np.stack([columns[name] for name in "xyz"], axis=1)
        placed = self._find_placed(local, frame)
        local = local[placed]
        intensity = self._fill_intensities(columns["intensity"][placed], frame).astype(np.float32)
        # Offsets count from the sweep's own time.
        offsets_ns, findings = fill_point_times(columns["offset_ns"][placed], 0.0, frame, "offset_ns")
        self._report(*findings)
        pose = self.world_SE3_lidar(frame)
        mount = self._mounts.get(_MAIN_LIDAR)
        return Sweep(
            points_world=local @ pose[:3, :3].T + pose[:3, 3],
            intensity=np.clip(intensity / np.float32(_INTENSITY_SCALE), 0.0, 1.0),
            timestamps_s=(time_ns + offsets_ns.astype(np.int64)) * np.float64(_NS),
            sensor_world=None if mount is None else (pose @ mount)[:3, 3],
        )

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """See ``DrivingLog``.

        Raises:
            InputError: there are boxes, and they cannot be read, or all are bad.
        """
        return self._tracks

    @cached_property
    def _tracks(self) -> tuple[CuboidTrack, ...]:
        path = self.folder / _BOXES
        # Logs of the test split have none.
        if not path.is_file():
            return ()
        texts, numbers = ("track_uuid", "category"), (*QUATERNION, *POSITION, *_SIZE_COLUMNS)
        columns = read_columns(path, ("timestamp_ns",), self.uri, texts, max_rows=MAX_BOXES, unchecked=numbers)
        return self._build_tracks(self._read_boxes(columns, path), self.world_SE3_lidar)

    def _read_boxes(self, columns: dict[str, Any], path: Path) -> list[LabelledBox]:
        frame_at = {int(time_ns): frame for frame, time_ns in enumerate(self._sweep_times_ns)}
        times_ns = columns["timestamp_ns"].astype(np.int64).tolist()
        # A part of a log may lack the sweeps of most boxes.
        rows = [row for row, time_ns in enumerate(times_ns) if time_ns in frame_at]
        if not rows:
            return []

        def locate(index: int) -> StatedBox:
            row = rows[index]
            track_id, label = columns["track_uuid"][row], columns["category"][row]
            return StatedBox(frame_at[times_ns[row]], track_id, label, f"{path.name}, row {row}")

        quats, positions, sizes = (
            np.stack([columns[name][rows] for name in names], axis=1) for names in (QUATERNION, POSITION, _SIZE_COLUMNS)
        )
        problems = find_bad_boxes(positions, sizes, quats=quats)
        self._report(*report_bad_boxes(problems, len(rows), locate, file=path, log=self.uri))
        sound = [row for index, row in enumerate(rows) if index not in problems]
        stated = {name: columns[name][sound] for name in (*QUATERNION, *POSITION, *_SIZE_COLUMNS)}
        rotations, centres = compose_poses(stated, path, self.uri)
        poses = np.tile(np.eye(4), (len(sound), 1, 1))
        poses[:, :3, :3] = rotations.as_matrix()
        poses[:, :3, 3] = centres
        boxes = []
        for row, pose, *size in zip(sound, poses, *(stated[name].tolist() for name in _SIZE_COLUMNS), strict=True):
            track_id, label = columns["track_uuid"][row], columns["category"][row]
            length, width, height = size
            boxes.append(LabelledBox(frame_at[times_ns[row]], track_id, label, pose, (length, width, height)))
        return boxes

    def findings(self) -> tuple[Finding, ...]:
        """What was left out so far, for ``genre check``."""
        return self._findings_after(self.cameras)

    def digest(self) -> str:
        """Identifies all files that are read."""
        tables = [self.folder / name for name in (_POSES, _MOUNTS, _LENSES, _BOXES)]
        files = [path for path in tables if path.is_file()]
        for timed in (*self._images.values(), self._sweeps):
            files += timed.values()
        return digest_files(self.folder, files, ())

    def _check_camera(self, camera: str, frame: int) -> None:
        self._check_camera_among(self._lenses, camera, frame)


def _list_timed_files(folder: Path) -> dict[int, Path]:
    """Time in ns → file."""
    if not folder.is_dir():
        return {}
    matches = ((_TIMED_FILE.fullmatch(path.name), path) for path in sorted(folder.iterdir()))
    # Larger numbers are no times, and fit in no table.
    return {int(match[1]): path for match, path in matches if match is not None and int(match[1]) < 1 << 63}
