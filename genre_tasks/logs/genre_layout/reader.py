"""Reader of the minimal layout for people's own logs: ``genre:PATH``."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.camera_names import is_plain_name
from genre_tasks.logs.file_digest import digest_files
from genre_tasks.logs.file_reading import read_file, read_json
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.genre_layout.box_table import read_boxes
from genre_tasks.logs.genre_layout.layout import (
    BOXES_FILE,
    FORMAT,
    LENS_KEYS,
    LOG_FILE,
    VERSION,
    EntryError,
    describe_entry_error,
    find_unknown_keys,
    parse_mapping,
    parse_number,
    parse_pose,
    parse_position,
    resolve_file,
)
from genre_tasks.logs.genre_layout.sweep_files import read_sweep
from genre_tasks.logs.lens_validity import with_distortion
from genre_tasks.logs.recorded_log import RecordedLog
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Lens, Sweep, Truth
from genre_tasks.user_paths import expand_user_path

# A frame with ten cameras has two kilobytes.
_MAX_JSON_BYTES = 1 << 28
# Rounding may lead just above 1.
_LARGEST_INTENSITY = 1.01


def open_genre_layout(rest: str) -> GenreLayoutLog:
    """Opens the folder of a log.

    Args:
        rest: path of the folder that holds log.json; ``~`` is the home folder.

    Returns:
        The log.

    Raises:
        InputError: there is no such folder, or its log.json is not of this layout.
    """
    folder = expand_user_path(rest)
    uri = f"genre:{rest}"
    if not rest or not (folder / LOG_FILE).is_file():
        logs = sorted(path.parent.name for path in folder.glob(f"*/{LOG_FILE}")) if rest else []
        hint = f" Logs in it: {', '.join(logs[:10])}." if logs else ""
        remedy = f"Give the folder that holds {LOG_FILE}, as in genre:PATH/my-log.{hint}"
        raise InputError(f"there is no {LOG_FILE}", remedy=remedy, file=folder, log=uri)
    return GenreLayoutLog(uri, folder)


class GenreLayoutLog(RecordedLog):
    """A ``DrivingLog`` over a folder of the layout; see ``DrivingLog`` for methods, units and axes.

    Args:
        uri: what the user wrote.
        folder: that holds log.json.

    Raises:
        InputError: log.json is not of this layout.
    """

    dataset = "genre"
    truth: Truth | None = None

    def __init__(self, uri: str, folder: Path) -> None:
        super().__init__(uri)
        self.folder = folder.resolve()
        self.name = re.sub(r"[^\w.=,+-]", "_", self.folder.name, flags=re.ASCII) or "log"
        self._file = self.folder / LOG_FILE
        # Before it is parsed, which takes ten times as much memory.
        size = self._file.stat().st_size
        if size > _MAX_JSON_BYTES:
            problem = f"the file has {size >> 20} MiB, and {_MAX_JSON_BYTES >> 20} are allowed"
            raise InputError(problem, remedy="Divide the log.", file=self._file, log=uri)
        values = read_json(self._file, uri)
        try:
            self._check_format(values)
            self.cameras = tuple(self._parse_camera(*entry) for entry in self._list_cameras(values))
            self._frames = self._list_frames(values)
            self.frame_count = len(self._frames)
            self._report(*find_unknown_keys(values))
        except EntryError as error:
            raise describe_entry_error(error, self._file, uri) from error

    def _check_format(self, values: object) -> None:
        entries = parse_mapping(values, LOG_FILE)
        if entries.get("format") != FORMAT:
            raise EntryError(f'the format is {entries.get("format")!r}, not "{FORMAT}"')
        if entries.get("version") != VERSION:
            raise EntryError(f"the version is {entries.get('version')!r}; this reader knows {VERSION}")

    def _list_cameras(self, values: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
        cameras = parse_mapping(values.get("cameras"), "cameras")
        if not cameras:
            raise EntryError("there are no cameras")
        return [(name, parse_mapping(camera, f"camera {name}")) for name, camera in cameras.items()]

    def _parse_camera(self, name: str, values: Mapping[str, Any]) -> Camera:
        what = f"camera {name}"
        if not is_plain_name(name):
            rule = "letters, digits and . = , + - _ are allowed, and dots alone are none"
            raise EntryError(f"{name!r} is no name of a camera: {rule}")
        numbers = {key: parse_number(values, key, what) for key in LENS_KEYS}
        sides = (numbers["width_px"], numbers["height_px"])
        is_whole = all(side >= 1 and side == int(side) for side in sides)
        if not is_whole or numbers["fx_px"] <= 0 or numbers["fy_px"] <= 0:
            raise EntryError(f"{what} has a focal length or a size that is not positive, or half a pixel")
        fx_px, fy_px, cx_px, cy_px = (numbers[key] for key in LENS_KEYS[:4])
        lens = Lens(fx_px, fy_px, cx_px, cy_px, int(sides[0]), int(sides[1]))
        readout_s = parse_number(values, "readout_s", what, 0.0)
        exposure_s = parse_number(values, "exposure_s", what, 0.0)
        if readout_s < 0 or exposure_s < 0:
            raise EntryError(f"{what} has negative seconds")
        lens = with_distortion(lens, dict(values), file=self._file, log=self.uri, camera=name)
        return Camera(name, lens, readout_s, exposure_s)

    def _list_frames(self, values: Mapping[str, Any]) -> list[Mapping[str, Any]]:
        frames = values.get("frames")
        if not isinstance(frames, list) or not frames:
            raise EntryError("there is no list of frames")
        return [parse_mapping(frame, f"frame {index}") for index, frame in enumerate(frames)]

    def _image_entry(self, camera: str, frame: int) -> Mapping[str, Any]:
        names = [known.name for known in self.cameras]
        self._check_camera_among(names, camera, frame)
        # Frames are parsed when they are asked for: one that is broken must not take the others with it.
        values = self._frame(frame)
        try:
            images = parse_mapping(values.get("images", {}), f"images of frame {frame}")
            return parse_mapping(images.get(camera, {}), f"{camera} of frame {frame}")
        except EntryError as error:
            raise describe_entry_error(error, self._file, self.uri) from error

    def _frame(self, frame: int) -> Mapping[str, Any]:
        return self._frames[self._check_frame(frame)]

    def _parse(self, parse: Any, *arguments: Any) -> Any:
        try:
            return parse(*arguments)
        except EntryError as error:
            raise describe_entry_error(error, self._file, self.uri) from error

    def frame_timestamp_s(self, frame: int) -> float:
        """See ``DrivingLog``."""
        return float(self._parse(parse_number, self._frame(frame), "time_s", f"frame {frame}"))

    def world_SE3_lidar(self, frame: int) -> Float64:
        """See ``DrivingLog``."""
        pose: Float64 = self._parse(parse_pose, self._frame(frame).get("lidar_pose"), f"lidar_pose of frame {frame}")
        return pose

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """See ``DrivingLog``; where a frame has neither image nor pose, mounted as at the nearest frame with a pose."""
        entry = self._image_entry(camera, frame)
        # A camera that is slower than the LiDAR has no entry at some frames, and is on the vehicle all the same.
        lacks_both = entry.get("pose") is None and entry.get("file") is None
        near = self._find_nearest_pose(camera, frame) if lacks_both else None
        if near is None:
            return self._parse_camera_pose(camera, frame)
        mount = np.linalg.inv(self.world_SE3_lidar(near)) @ self._parse_camera_pose(camera, near)
        pose: Float64 = self.world_SE3_lidar(frame) @ mount
        return pose

    def _parse_camera_pose(self, camera: str, frame: int) -> Float64:
        entry = self._image_entry(camera, frame)
        pose: Float64 = self._parse(parse_pose, entry.get("pose"), f"pose of {camera} in frame {frame}")
        return pose

    def _find_nearest_pose(self, camera: str, frame: int) -> int | None:
        """The frame nearest to this one that has a pose of the camera; of two the earlier one."""
        frames = self._frames_with_pose[camera]
        after = bisect_left(frames, frame)
        return min(frames[max(after - 1, 0) : after + 1], key=lambda near: abs(near - frame), default=None)

    @cached_property
    def _frames_with_pose(self) -> dict[str, list[int]]:
        """Camera → frames whose entry has a pose, in order; listed once, so that long logs take no quadratic time."""
        found: dict[str, list[int]] = {camera.name: [] for camera in self.cameras}
        for frame, values in enumerate(self._frames):
            images = values.get("images")
            # What is broken is an error of its frame, and no place to look for a pose.
            for name, entry in images.items() if isinstance(images, dict) else ():
                if name in found and isinstance(entry, dict) and entry.get("pose") is not None:
                    found[name].append(frame)
        return found

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """See ``DrivingLog``; the frame's time where the image has none."""
        entry = self._image_entry(camera, frame)
        what = f"{camera} of frame {frame}"
        # Asked for only where it is needed: a frame without a time must not cost an image that has one.
        if "time_s" not in entry:
            return self.frame_timestamp_s(frame)
        return float(self._parse(parse_number, entry, "time_s", what))

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """See ``DrivingLog``."""
        path = self._image_file(camera, frame)
        return None if path is None else read_file(path, log=self.uri, camera=camera, frame=frame)

    def _image_file(self, camera: str, frame: int) -> Path | None:
        name = self._image_entry(camera, frame).get("file")
        what = f"the file of {camera} in frame {frame}"
        return None if name is None else self._parse(resolve_file, self.folder, name, what)

    def sweep(self, frame: int) -> Sweep | None:
        """See ``DrivingLog``; points without a finite place are left out."""
        path = self._sweep_file(frame)
        if path is None:
            return None
        found = read_sweep(path, self.frame_timestamp_s(frame), self.uri, frame)
        self._report(*found.findings)
        if found.largest_intensity > _LARGEST_INTENSITY:
            # Of one scale in all sweeps: said once, and not of each.
            message = "sweeps have intensities above 1, which are cut to 1"
            numbers = {"largest": found.largest_intensity}
            self._report(Finding("intensity_scale", "warning", message, "Write them from 0 to 1.", numbers))
        stated = self._frame(frame).get("lidar_position")
        return replace(
            found.sweep, sensor_world=self._parse(parse_position, stated, f"lidar_position of frame {frame}")
        )

    def _sweep_file(self, frame: int) -> Path | None:
        name = self._frame(frame).get("sweep")
        return None if name is None else self._parse(resolve_file, self.folder, name, f"the sweep of frame {frame}")

    @cached_property
    def _tracks(self) -> tuple[CuboidTrack, ...]:
        path = self.folder / BOXES_FILE
        if not path.is_file():
            return ()
        tracks, findings = read_boxes(path, self.frame_count, self.uri)
        self._report(*findings)
        return tracks

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """See ``DrivingLog``."""
        return self._tracks

    def findings(self) -> tuple[Finding, ...]:
        """What sweeps and boxes that were read so far had to leave out."""
        return tuple(self._findings.values())

    def digest(self) -> str:
        """Identifies log.json and every file that it names."""
        # What else lies in the folder is the user's own.
        frames = range(self.frame_count)
        named = {self._file}
        for frame in frames:
            readers = [partial(self._image_file, camera.name, frame) for camera in self.cameras]
            for find_file in (*readers, partial(self._sweep_file, frame)):
                # An entry without sense names no file. It costs its frame, and log.json tells it from others.
                with suppress(InputError):
                    path = find_file()
                    if path is not None:
                        named.add(path)
        boxes = self.folder / BOXES_FILE
        return digest_files(self.folder, named | ({boxes} if boxes.is_file() else set()), ())
