"""Reader of nuScenes: ``nuscenes:ROOT/scene-0061``."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.camera_names import require_camera_names
from genre_tasks.logs.file_digest import digest_files
from genre_tasks.logs.file_reading import read_file
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.image_sizes import choose_lens, describe_no_images, measure_images, report_problems
from genre_tasks.logs.labelled_boxes import describe_repeated
from genre_tasks.logs.nearest_images import find_nearest_images
from genre_tasks.logs.nuscenes.box_interpolation import (
    find_repeated_boxes,
    interpolate_boxes,
    leave_out_bad_boxes,
)
from genre_tasks.logs.nuscenes.scene_address import SceneAddress, parse_scene_address
from genre_tasks.logs.nuscenes.scene_index import read_scene_index
from genre_tasks.logs.nuscenes.scene_rows import SceneRows, SensorData, read_scene
from genre_tasks.logs.recorded_log import RecordedLog
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Lens, Sweep, Truth

_MAIN_LIDAR = "LIDAR_TOP"
_US = 1e-6
_POINT_BYTES = 20
# Fifty times what its LiDAR measures in one turn.
_MAX_POINTS = 2_000_000
# Beams that did not return, and a part of the vehicle's own roof.
_MIN_DISTANCE_M = 1.0
CAR_LOW_M = (-1.0, -1.05)
CAR_HIGH_M = (3.6, 1.05)
"""Rear right and front left corner of the recording car, in its own axes, whose origin is the rear axle. Its roof and
its bonnet answer too: in a sweep of the dataset up to 3 m ahead, and the car ends half a metre later."""

_INTENSITY_SCALE = 255.0
# nuScenes counts from the centre of the first pixel, as OpenCV's calibration does.
_PIXEL_CENTRE = 0.5
# Three quarters of a frame: a sweep may come early.
_MIN_STEP_US = 75_000
_ASSUMED_PERIOD_US = 100_000
_COPY_REMEDY = "Unpack the sensor data of this scene again."


def open_nuscenes(rest: str) -> NuScenesLog:
    """Opens a scene; the first time, an index of all scenes is made, which takes minutes for the full dataset.

    Args:
        rest: ``ROOT/SCENE?version=VERSION&rate=RATE``. VERSION is the folder of the tables, where ROOT has several.
            RATE is 2 (key frames), 10 (the default: every second sweep) or 20 (all sweeps).

    Returns:
        The log.

    Raises:
        InputError: no such scene or version; a table is missing or malformed, or points to rows that are not there.
        ConfigError: an option is unknown.
        ResourceError: the index cannot be written.
    """
    address = parse_scene_address(rest)
    uri = f"nuscenes:{rest}"
    rows = read_scene_index(address.tables, uri, lambda index: read_scene(index, address.scene, address.tables, uri))
    return NuScenesLog(uri, address, rows)


class NuScenesLog(RecordedLog):
    """A ``DrivingLog`` over a scene of nuScenes; see ``DrivingLog`` for methods, units and axes.

    A frame is a sweep of the LiDAR; each camera gives its image that is nearest in time, with the pose of that image.
    Images are undistorted, and sweeps moved to one time, by the dataset itself. The world is the map's.

    Args:
        uri: what the user wrote.
        address: of the scene.
        rows: of the scene.

    Raises:
        InputError: the scene has no data, none of its files is there, or the name of a camera leads out of a folder.
    """

    dataset = "nuscenes"
    truth: Truth | None = None

    def __init__(self, uri: str, address: SceneAddress, rows: SceneRows) -> None:
        super().__init__(uri)
        self.folder = address.root
        self.name = re.sub(r"[^\w.=,+-]", "_", address.scene, flags=re.ASCII)
        self._tables = address.tables
        self._rows = rows
        require_camera_names(rows.cameras, log=uri, file=self._tables / "sensor.json")
        main = _MAIN_LIDAR if _MAIN_LIDAR in rows.lidars else next(iter(rows.lidars), None)
        # Without a LiDAR, a camera is the clock.
        clock = rows.lidars[main] if main else next(iter(rows.cameras.values()), ())
        self._frames = _select_frames(clock, address.rate_hz)
        self.frame_count = len(self._frames)
        if not self.frame_count:
            raise InputError("the scene has no data", remedy=_COPY_REMEDY, file=self._tables, log=uri)
        times_us = [datum.time_us for datum in self._frames]
        self._images = {name: _choose_data(data, times_us) for name, data in rows.cameras.items()}
        self._sweeps = {name: _choose_data(data, times_us) for name, data in rows.lidars.items()}
        # Frames that lie close together may share a nearest sweep; each has its own.
        if main:
            self._sweeps[main] = list(self._frames)
        # The sensor data come in parts that are downloaded apart: a scene may have none of them.
        if not any(self._path(datum).is_file() for datum in self._list_data()):
            problem = f"none of the scene's files is there, such as {self._frames[0].file}"
            raise InputError(problem, remedy=_COPY_REMEDY, file=self.folder, log=uri)

    def _path(self, datum: SensorData) -> Path:
        return self.folder / datum.file

    def _list_data(self) -> list[SensorData]:
        channels = (*self._sweeps.values(), *self._images.values())
        return [datum for data in channels for datum in data if datum is not None]

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras that have images, by name."""
        cameras = []
        for name, data in self._images.items():
            paths = {frame: self._path(datum) for frame, datum in enumerate(data) if datum is not None}
            measured = measure_images({frame: path for frame, path in paths.items() if path.is_file()})
            self._report(*report_problems(measured, name))
            if measured.majority is None:
                self._report(describe_no_images(measured, name))
                continue
            first = self._rows.cameras[name][0]
            lens, findings = choose_lens(_build_lens(first, measured.majority), measured, name)
            self._report(*findings)
            cameras.append(Camera(name, lens))
        return tuple(cameras)

    def frame_timestamp_s(self, frame: int) -> float:
        """See ``DrivingLog``: when the LiDAR's turn ends."""
        return self._frames[self._check_frame(frame)].time_us * _US

    def world_SE3_lidar(self, frame: int) -> Float64:
        """See ``DrivingLog``: the vehicle's own frame, whose axes are x forward, y left, z up."""
        return self._frames[self._check_frame(frame)].world_SE3_vehicle.copy()

    def _image(self, camera: str, frame: int) -> SensorData | None:
        self._check_camera_among(self._images, camera, frame)
        return self._images[camera][self._check_frame(frame)]

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """See ``DrivingLog``; at the time of the frame where it has no image."""
        datum = self._image(camera, frame)
        mount = self._rows.cameras[camera][0].vehicle_SE3_sensor if datum is None else datum.vehicle_SE3_sensor
        pose: Float64 = (self._frames[frame] if datum is None else datum).world_SE3_vehicle @ mount
        return pose

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """See ``DrivingLog``; the frame's time where it has no image."""
        datum = self._image(camera, frame)
        return self.frame_timestamp_s(frame) if datum is None else datum.time_us * _US

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """See ``DrivingLog``; a file that is not there is a missing image."""
        datum = self._image(camera, frame)
        if datum is None or not self._path(datum).exists():
            return None
        return read_file(self._path(datum), log=self.uri, camera=camera, frame=frame)

    def sweep(self, frame: int) -> Sweep | None:
        """See ``DrivingLog``: all LiDARs; points within a metre of one, and on the recording car, are left out.

        Raises:
            InputError: no such frame, or a sweep that cannot be read.
        """
        self._check_frame(frame)
        data = [sweeps[frame] for sweeps in self._sweeps.values()]
        found = [datum for datum in data if datum is not None and self._path(datum).exists()]
        if not found:
            return None
        parts = [self._read_sweep(datum, frame) for datum in found]
        # Frames are the main LiDAR's data.
        main = self._frames[frame]
        return Sweep(
            points_world=np.concatenate([part.points_world for part in parts]),
            intensity=np.concatenate([part.intensity for part in parts]),
            timestamps_s=np.concatenate([part.timestamps_s for part in parts]),
            sensor_world=(main.world_SE3_vehicle @ main.vehicle_SE3_sensor)[:3, 3],
        )

    def _read_sweep(self, datum: SensorData, frame: int) -> Sweep:
        path = self._path(datum)
        # Before it is read: the file may be anything.
        size = path.stat().st_size
        if size % _POINT_BYTES or size > _MAX_POINTS * _POINT_BYTES:
            problem = f"the sweep has {size} bytes, which are not up to {_MAX_POINTS} points of {_POINT_BYTES}"
            raise InputError(problem, remedy=_COPY_REMEDY, file=path, log=self.uri, frame=frame)
        rows = np.frombuffer(read_file(path, log=self.uri, frame=frame), dtype="<f4").reshape(-1, 5)[:, :4]
        rows = rows[self._find_placed(rows[:, :3], frame)]
        rows = rows[np.hypot(rows[:, 0], rows[:, 1]) >= _MIN_DISTANCE_M]
        mount = datum.vehicle_SE3_sensor
        place = rows[:, :3] @ mount[:2, :3].T + mount[:2, 3]
        rows = rows[~((place > CAR_LOW_M) & (place < CAR_HIGH_M)).all(1)]
        pose = datum.world_SE3_vehicle @ datum.vehicle_SE3_sensor
        return Sweep(
            points_world=rows[:, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3],
            intensity=np.clip(self._fill_intensities(rows[:, 3], frame) / np.float32(_INTENSITY_SCALE), 0.0, 1.0),
            timestamps_s=np.full(len(rows), datum.time_us * _US),
        )

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """See ``DrivingLog``: boxes of key frames, interpolated to the frames between them."""
        return self._boxes[0]

    @cached_property
    def _boxes(self) -> tuple[tuple[CuboidTrack, ...], int]:
        boxes = self._rows.boxes
        # Boxes were drawn around the key frame's own sweep.
        key_times = {
            datum.sample: datum.time_us for data in self._rows.lidars.values() for datum in data if datum.is_key_frame
        }
        times_us = tuple(
            key_times.get(sample, time) for sample, time in zip(boxes.samples, boxes.times_us, strict=True)
        )
        boxes = replace(boxes, times_us=times_us)
        frame_times_us = [datum.time_us for datum in self._frames]
        file = self._tables / "sample_annotation.json"
        boxes, findings = leave_out_bad_boxes(boxes, frame_times_us, file=file, log=self.uri)
        self._report(*findings)
        self._report(*describe_repeated(find_repeated_boxes(boxes, frame_times_us)))
        labelled, interpolated = interpolate_boxes(boxes, frame_times_us)
        identity = np.eye(4)
        return self._build_tracks(labelled, lambda frame: identity), interpolated

    def findings(self) -> tuple[Finding, ...]:
        """What was left out or interpolated, for ``genre check``."""
        # Boxes first, which add to the findings.
        tracks, interpolated = self._boxes
        found = self._findings_after(self.cameras)
        if not tracks:
            message = "there are no boxes, as in the test split"
            remedy = "Without boxes, whatever moves is smeared over its path."
            found += (Finding("no_labels", "note", message, remedy),)
        if interpolated:
            total = sum(len(track.frames) for track in tracks)
            message = f"boxes are stated at key frames; {interpolated} of {total} are interpolated between two of them"
            numbers = {"interpolated": interpolated, "boxes": total}
            found += (Finding("interpolated_boxes", "note", message, numbers=numbers),)
        return found

    def _list_readable_tracks(self) -> tuple[CuboidTrack, ...]:
        """The objects; none where no box can be used, which a run reports and goes on without."""
        try:
            return self.tracks()
        except InputError:
            return ()

    def digest(self) -> str:
        """Identifies the scene's rows and all files that are read."""
        total = hashlib.sha256()
        channels: dict[str, Sequence[SensorData | None]] = {**self._images, **self._sweeps, "": self._frames}
        for name, data in sorted(channels.items()):
            for datum in data:
                total.update(f"{name}\0{_describe_datum(datum)}\n".encode(errors="surrogateescape"))
        for track in self._list_readable_tracks():
            values = np.concatenate([track.frames, track.world_SE3_box.ravel(), track.size_m])
            total.update(f"{track.track_id}\0{track.label}\0{values.tolist()}\n".encode())
        files = {self._path(datum) for datum in self._list_data()}
        total.update(digest_files(self.folder, (path for path in files if path.exists()), ()).encode())
        return total.hexdigest()


def _select_frames(clock: Sequence[SensorData], rate_hz: int) -> list[SensorData]:
    """Data that become frames, with increasing times."""
    if rate_hz == 2:
        clock = [datum for datum in clock if datum.is_key_frame]
    least_us = _MIN_STEP_US if rate_hz == 10 else 1
    frames: list[SensorData] = []
    for datum in clock:
        if not frames or datum.time_us - frames[-1].time_us >= least_us:
            frames.append(datum)
    return frames


def _choose_data(data: Sequence[SensorData], frame_times_us: list[int]) -> list[SensorData | None]:
    """For each frame the nearest datum of a sensor."""
    nearest = find_nearest_images(frame_times_us, [datum.time_us for datum in data], _ASSUMED_PERIOD_US)
    return [None if index is None else data[index] for index in nearest]


def _build_lens(datum: SensorData, majority: tuple[int, int]) -> Lens:
    assert datum.lens is not None
    fx_px, fy_px, cx_px, cy_px = datum.lens
    stated = min(datum.size_px) > 0
    width_px, height_px = datum.size_px if stated else majority
    return Lens(fx_px, fy_px, cx_px + _PIXEL_CENTRE, cy_px + _PIXEL_CENTRE, width_px, height_px)


def _describe_datum(datum: SensorData | None) -> str:
    if datum is None:
        return ""
    numbers: NDArray[np.float64] = np.concatenate([datum.world_SE3_vehicle.ravel(), datum.vehicle_SE3_sensor.ravel()])
    return f"{datum.time_us}\0{datum.file}\0{numbers.tolist()}\0{datum.lens}\0{datum.size_px}"
