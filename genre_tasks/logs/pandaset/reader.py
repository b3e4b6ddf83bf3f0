"""Reader of the PandaSet layout: ``pandaset:PATH/002``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.file_digest import digest_files
from genre_tasks.logs.file_reading import (
    describe_value,
    read_entries,
    read_file,
    read_json,
    read_number,
    read_times,
)
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.image_sizes import choose_lens, describe_no_images, measure_images, report_problems
from genre_tasks.logs.lens_validity import with_distortion
from genre_tasks.logs.pandaset.cuboids import FrameBoxes, build_tracks, read_boxes
from genre_tasks.logs.pandaset.folder_index import LIDAR_FILES, SequenceIndex, index_sequence
from genre_tasks.logs.pandaset.layout import PIXEL_CENTRE, RIG_ORDER, assume_readout, parse_pose, to_flu_axes
from genre_tasks.logs.pandaset.pickle_reader import read_table
from genre_tasks.logs.pandaset.sweeps import build_sweep
from genre_tasks.logs.pandaset.unread_files import find_unread_files
from genre_tasks.logs.recorded_log import RecordedLog
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Lens, Sweep, Truth
from genre_tasks.user_paths import expand_user_path

_MAX_SEQUENCES_LISTED = 10
_MAX_KEYS_LISTED = 8
_INTRINSIC_KEYS = ("fx", "fy", "cx", "cy")
_INTRINSICS_REMEDY = 'Write {"fx": …, "fy": …, "cx": …, "cy": …} in pixels of the images.'


def open_pandaset(rest: str) -> PandaSetLog:
    """Opens the folder of one PandaSet sequence.

    Args:
        rest: path of the folder, which is what follows ``pandaset:`` in a URI; ``~`` is the home folder.

    Returns:
        The log.

    Raises:
        InputError: no such folder, or no sequence in it (names what was looked for).
    """
    uri = f"pandaset:{rest}"
    remedy = "Give the folder of one sequence, as in pandaset:PATH/002."
    if "*" in rest:
        remedy += " Only `genre dataset`, `genre cost` and `genre table` take several, for which a star stands."
    folder = expand_user_path(rest)
    try:
        is_folder = bool(rest) and folder.is_dir()
    # A name that is too long, or a folder above it that may not be entered.
    except (OSError, ValueError) as error:
        raise InputError(f"the folder cannot be opened ({error})", remedy=remedy, file=rest, log=uri) from error
    if not is_folder:
        problem = "there is no such sequence folder"
        if rest and folder.is_file():
            problem = "this is a file and not a sequence folder; unpack an archive first"
        raise InputError(problem, remedy=remedy, file=folder, log=uri)
    index = index_sequence(folder)
    missing = [f"lidar/{name}" for name in LIDAR_FILES if name not in index.lidar.settings]
    if missing:
        raise _describe_no_sequence(index, missing, uri, remedy)
    return PandaSetLog(uri, folder, index)


def _describe_no_sequence(index: SequenceIndex, missing: list[str], uri: str, remedy: str) -> InputError:
    """The error for a folder that is no sequence: a user may well name the folder above or below."""
    folder = index.root
    unlistable = [f"{name} cannot be listed ({reason})" for name, reason in index.unlistable]
    sequences = sorted(path.parent.parent.name for path in folder.glob("*/lidar/poses.json"))
    if sequences:
        remedy += f" Sequences in it: {', '.join(sequences[:_MAX_SEQUENCES_LISTED])}."
    elif (folder.parent / "lidar/poses.json").exists():
        remedy += f" The folder above it is one: {folder.parent}."
    problem = f"no PandaSet sequence here: no {' and no '.join(missing)}"
    return InputError("; ".join([problem, *unlistable]), remedy=remedy, file=folder, log=uri)


class PandaSetLog(RecordedLog):
    """A ``DrivingLog`` over a PandaSet sequence folder; see ``DrivingLog`` for methods, units and axes.

    The world frame is PandaSet's own. Of a sweep, the points of the spinning 64-beam LiDAR are read (``d == 0``).
    Frames keep the order of the files, whatever their timestamps say. The folder is listed once, when the log is
    opened.

    Args:
        uri: what the user wrote.
        folder: the sequence folder.
        index: what lies in it; listed here where it is ``None``.

    Raises:
        InputError: the LiDAR's poses or timestamps cannot be read, or are not equally many.
    """

    dataset = "pandaset"
    truth: Truth | None = None

    def __init__(self, uri: str, folder: Path, index: SequenceIndex | None = None) -> None:
        super().__init__(uri)
        self.folder = folder
        self.name = folder.resolve().name
        self._index = index_sequence(folder) if index is None else index
        self._lidar_poses = read_entries(self._index.lidar.setting("poses.json"), uri)
        self.frame_count = len(self._lidar_poses)
        self._lidar_times = self._read_times(self._index.lidar.setting("timestamps.json"))
        self._camera_tables: dict[str, tuple[list[object], Float64]] = {}

    def _read_times(self, path: Path) -> Float64:
        """[F] seconds, from a JSON file of the sequence."""
        times = read_times(path, self.uri)
        self._check_length(len(times), path)
        return times

    def _check_length(self, count: int, path: Path) -> None:
        if count != self.frame_count:
            problem = f"{count} entries, but lidar/poses.json has {self.frame_count} frames"
            remedy = "Copy the whole sequence folder again."
            raise InputError(problem, remedy=remedy, file=path, log=self.uri)

    # Read when first asked for: opening a log must stay cheap, and a folder may lack cameras that nobody uses.
    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """In rig order: front, front left, front right, left, right, back; then any others by name."""
        found = {name for name, folder in self._index.cameras.items() if "intrinsics.json" in folder.settings}
        names = [name for name in RIG_ORDER if name in found] + sorted(found.difference(RIG_ORDER))
        cameras = [self._read_camera(name) for name in names]
        return tuple(camera for camera in cameras if camera is not None)

    def _read_camera(self, name: str) -> Camera | None:
        """The camera, or ``None`` if none of its images says how large they are."""
        path = self._index.cameras[name].setting("intrinsics.json")
        intrinsics = read_json(path, self.uri)
        files = self._index.cameras[name].files
        measured = measure_images({frame: files[frame] for frame in files if frame < self.frame_count})
        if measured.majority is None:
            self._report(describe_no_images(measured, name))
            return None
        self._report(*report_problems(measured, name))
        where: dict[str, Any] = {"file": path, "log": self.uri, "camera": name}
        try:
            fx, fy, cx, cy = (read_number(intrinsics[key]) for key in ("fx", "fy", "cx", "cy"))
            exposure_s = read_number(intrinsics.get("exposure_s", 0.0))
            width, height = (int(read_number(intrinsics.get(k, v))) for k, v in _name_sides(measured.majority))
            readout_s = read_number(intrinsics.get("readout_s", assume_readout(name, width, height)))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(_describe_bad_intrinsics(intrinsics, error), remedy=_INTRINSICS_REMEDY, **where) from error
        if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0 and width > 0 and height > 0):
            problem = "the intrinsics are not finite, or a focal length or a size is not positive"
            raise InputError(problem, remedy="Correct the file.", **where)
        if not (np.isfinite([readout_s, exposure_s]).all() and readout_s >= 0 and exposure_s >= 0):
            problem = f"readout_s is {readout_s:g} and exposure_s {exposure_s:g}; seconds from 0 were expected"
            raise InputError(problem, remedy="Correct them; 0 stands for a global shutter.", **where)
        lens = Lens(
            fx_px=fx,
            fy_px=fy,
            # The file counts from the centre of the first pixel.
            cx_px=cx + PIXEL_CENTRE,
            cy_px=cy + PIXEL_CENTRE,
            width_px=width,
            height_px=height,
        )
        lens, findings = choose_lens(with_distortion(lens, intrinsics, **where), measured, name)
        self._report(*findings)
        return Camera(name, lens, readout_s, exposure_s)

    def _poses_and_times(self, camera: str, frame: int) -> tuple[list[object], Float64]:
        """Entries of a camera's ``poses.json``, and [F] seconds; ``frame`` is for the error."""
        names = [known.name for known in self.cameras]
        self._check_camera_among(names, camera, frame)
        # Camera by camera, since one that is broken must not take the others with it.
        if camera not in self._camera_tables:
            folder = self._index.cameras[camera]
            poses = read_entries(folder.setting("poses.json"), self.uri)
            self._check_length(len(poses), folder.setting("poses.json"))
            self._camera_tables[camera] = (poses, self._read_times(folder.setting("timestamps.json")))
        return self._camera_tables[camera]

    def frame_timestamp_s(self, frame: int) -> float:
        """See ``DrivingLog``."""
        return float(self._lidar_times[self._check_frame(frame)])

    def world_SE3_lidar(self, frame: int) -> Float64:
        """See ``DrivingLog``; the file's x right, y forward, z up is turned to x forward, y left, z up.

        Raises:
            InputError: no such frame, or the recorded pose is not finite.
        """
        pose = self._lidar_poses[self._check_frame(frame)]
        return to_flu_axes(parse_pose(pose, file=self._index.lidar.setting("poses.json"), log=self.uri, frame=frame))

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """See ``DrivingLog``; PandaSet's camera axes are x right, y down, z forward too.

        Raises:
            InputError: no such camera or frame, or the recorded pose is not finite.
        """
        poses, _ = self._poses_and_times(camera, frame)
        pose = poses[self._check_frame(frame)]
        file = self._index.cameras[camera].setting("poses.json")
        return parse_pose(pose, file=file, log=self.uri, frame=frame, camera=camera)

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """See ``DrivingLog``."""
        _, times = self._poses_and_times(camera, frame)
        return float(times[self._check_frame(frame)])

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """See ``DrivingLog``.

        Raises:
            InputError: no such camera or frame, or a file that cannot be read.
        """
        self._poses_and_times(camera, frame)
        path = self._index.cameras[camera].files.get(self._check_frame(frame))
        return None if path is None else read_file(path, log=self.uri, camera=camera, frame=frame)

    def sweep(self, frame: int) -> Sweep | None:
        """See ``DrivingLog``; points of the forward LiDAR, and points without a finite place, are left out.

        Raises:
            InputError: no such frame, or a sweep that cannot be read.
        """
        path = self._index.lidar.files.get(self._check_frame(frame))
        # A sequence may lack sweeps: real ones do.
        if path is None:
            return None
        table = read_table(path, log=self.uri, frame=frame)
        frame_time_s = self.frame_timestamp_s(frame)
        sweep, findings = build_sweep(table, frame, frame_time_s, file=path, log=self.uri)
        self._report(*findings)
        return sweep

    @cached_property
    def _tracks(self) -> tuple[CuboidTrack, ...]:
        tracks, findings = build_tracks(self._read_cuboids(), self.uri)
        self._report(*findings)
        return tracks

    def _read_cuboids(self) -> list[FrameBoxes]:
        """The boxes of the frames that have readable ones; one bad file must not take all tracks with it."""
        files = self._index.cuboids.files
        frames = []
        errors: list[InputError] = []
        for frame in range(self.frame_count):
            if frame in files:
                try:
                    table = read_table(files[frame], log=self.uri, frame=frame)
                    frames.append(read_boxes(table, frame, file=files[frame], log=self.uri))
                except InputError as error:
                    errors.append(error)
        if errors and not frames:
            raise errors[0]
        for unread in errors:
            # The file's place must not change what a run stores: the frame says which file it is.
            message = f"the cuboids of frame {unread.frame} are left out: {unread.problem}"
            bad_frames = () if unread.frame is None else (unread.frame,)
            self._report(Finding("unreadable_cuboids", "warning", message, unread.remedy, frames=bad_frames))
        return frames

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """See ``DrivingLog``; an object that both LiDARs saw is one track.

        Raises:
            InputError: there are cuboids, and those of no frame can be read, or all of them are bad.
        """
        return self._tracks

    @cached_property
    def _unread(self) -> tuple[Finding, ...]:
        return find_unread_files(self._index, self.frame_count)

    def findings(self) -> tuple[Finding, ...]:
        """What lies in the folder and is not read, and what cameras, tracks and sweeps read so far had to leave out.

        Returns:
            One entry per thing. What cannot be read at all is no finding here: reading it raises.
        """
        for part in ("cameras", "_tracks"):
            with contextlib.suppress(InputError):
                getattr(self, part)
        return (*self._unread, *self._findings.values())

    def digest(self) -> str:
        """Identifies the files that are read, and what is to be warned of; what else lies in the folder does not count.

        Returns:
            sha256, hexadecimal; the folder's own path does not count.
        """
        return digest_files(self.folder, self._index.read_files(self.frame_count), self._unread)


def _describe_bad_intrinsics(intrinsics: object, error: Exception) -> str:
    """What is there in place of numbers for the keys of the layout."""
    if not isinstance(intrinsics, dict):
        return f"an object with fx, fy, cx and cy was expected, found {describe_value(intrinsics)}"
    missing = [key for key in _INTRINSIC_KEYS if key not in intrinsics]
    if missing:
        names = [str(key) for key in intrinsics]
        more = ", …" if len(names) > _MAX_KEYS_LISTED else ""
        found = ", ".join(names[:_MAX_KEYS_LISTED]) or "none"
        return f"fx, fy, cx, cy were expected: the file lacks {', '.join(missing)}; its keys are {found}{more}"
    return f"a number of the intrinsics cannot be read: {error}"


def _name_sides(size: tuple[int, int]) -> Iterator[tuple[str, int]]:
    """Keys of ``intrinsics.json`` that state the size of the images, with their defaults."""
    return zip(("width", "height"), size, strict=True)
