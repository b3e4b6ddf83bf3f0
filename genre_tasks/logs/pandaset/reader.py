"""Reader of the PandaSet layout: ``pandaset:PATH/002``."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.lens_validity import with_distortion
from genre_tasks.logs.pandaset.cuboids import build_tracks
from genre_tasks.logs.pandaset.layout import (
    IMAGE_SUFFIXES,
    INTENSITY_SCALE,
    PIXEL_CENTRE,
    READOUT_S,
    RIG_ORDER,
    SPINNING_SENSOR,
    convert_to_seconds,
    frame_stem,
    parse_pose,
    read_json,
    to_flu_axes,
)
from genre_tasks.logs.pandaset.pickle_reader import Table, read_table
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Lens, Sweep, Truth
from genre_tasks.suggestions import did_you_mean

_REQUIRED_FILES = ("lidar/poses.json", "lidar/timestamps.json")
_DIGESTED_FILES = ("camera/*/*", "lidar/*", "annotations/cuboids/*")
_MAX_SEQUENCES_LISTED = 10


def open_pandaset(rest: str) -> PandaSetLog:
    """Opens the folder of one PandaSet sequence.

    Args:
        rest: path of the folder, which is what follows ``pandaset:`` in a URI; ``~`` is the home folder.

    Returns:
        The log.

    Raises:
        InputError: no such folder, or no sequence in it (names what was looked for).
    """
    folder = Path(rest).expanduser()
    uri = f"pandaset:{rest}"
    remedy = "Give the folder of one sequence, as in pandaset:PATH/002."
    if not rest or not folder.is_dir():
        raise InputError("there is no such sequence folder", remedy=remedy, file=folder, log=uri)
    missing = [name for name in _REQUIRED_FILES if not (folder / name).is_file()]
    if missing:
        # A user may well name the folder above the sequences: list what is in it.
        sequences = sorted(path.parent.parent.name for path in folder.glob("*/lidar/poses.json"))
        if sequences:
            remedy += f" Sequences in it: {', '.join(sequences[:_MAX_SEQUENCES_LISTED])}."
        problem = f"no PandaSet sequence here: no {' and no '.join(missing)}"
        raise InputError(problem, remedy=remedy, file=folder, log=uri)
    return PandaSetLog(uri, folder)


class PandaSetLog:
    """A ``DrivingLog`` over a PandaSet sequence folder; see ``DrivingLog`` for methods, units and axes.

    The world frame is PandaSet's own. Only the spinning 64-beam LiDAR is read (``d == 0``). Frames keep the order of
    the files, whatever their timestamps say.

    Args:
        uri: what the user wrote.
        folder: the sequence folder.

    Raises:
        InputError: the LiDAR's poses or timestamps cannot be read, or are not equally many.
    """

    dataset = "pandaset"
    truth: Truth | None = None

    def __init__(self, uri: str, folder: Path) -> None:
        self.uri = uri
        self.folder = folder
        self.name = folder.resolve().name
        self._lidar_poses = self._read_list("lidar/poses.json")
        self.frame_count = len(self._lidar_poses)
        self._lidar_times = self._read_times("lidar/timestamps.json")
        self._findings: dict[str, Finding] = {}

    def _read_list(self, name: str) -> list[object]:
        """The entries of a JSON file of the sequence, which has one for every frame."""
        path = self.folder / name
        entries = read_json(path, self.uri)
        if not isinstance(entries, list) or not entries:
            problem = "a list of one entry a frame was expected"
            raise InputError(problem, remedy="Copy it again.", file=path, log=self.uri)
        return entries

    def _read_times(self, name: str) -> Float64:
        """[F] seconds, from a JSON file of the sequence."""
        times = convert_to_seconds(np.array(self._read_list(name), dtype=np.float64))
        self._check_length(len(times), name)
        return times

    def _check_length(self, count: int, name: str) -> None:
        if count != self.frame_count:
            problem = f"{count} entries, but lidar/poses.json has {self.frame_count} frames"
            remedy = "Copy the whole sequence folder again."
            raise InputError(problem, remedy=remedy, file=self.folder / name, log=self.uri)

    def _check_frame(self, frame: int) -> int:
        if not 0 <= frame < self.frame_count:
            remedy = f"The log has frames 0 to {self.frame_count - 1}."
            raise InputError("no such frame", remedy=remedy, log=self.uri, frame=frame)
        return frame

    # Read when first asked for: opening a log must stay cheap, and a folder may lack cameras that nobody uses.
    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """In rig order: front, front left, front right, left, right, back; then any others by name."""
        found = {path.parent.name for path in (self.folder / "camera").glob("*/intrinsics.json")}
        names = [name for name in RIG_ORDER if name in found] + sorted(found.difference(RIG_ORDER))
        cameras = [self._read_camera(name) for name in names]
        return tuple(camera for camera in cameras if camera is not None)

    def _read_camera(self, name: str) -> Camera | None:
        """The camera, or ``None`` if none of its images says how large they are."""
        path = self.folder / "camera" / name / "intrinsics.json"
        intrinsics = read_json(path, self.uri)
        size = self._read_image_size(name)
        if size is None:
            message = f"{name} has no readable image and is left out"
            remedy = "Copy the camera's folder again, or remove it."
            self._report(Finding("camera_without_images", "warning", message, remedy, camera=name))
            return None
        where: dict[str, Any] = {"file": path, "log": self.uri, "camera": name}
        try:
            fx, fy, cx, cy = (float(intrinsics[key]) for key in ("fx", "fy", "cx", "cy"))
            readout_s = float(intrinsics.get("readout_s", READOUT_S))
            exposure_s = float(intrinsics.get("exposure_s", 0.0))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            problem = f"fx, fy, cx, cy were expected ({error!r})"
            raise InputError(problem, remedy="Copy it again.", **where) from error
        if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
            problem = "the intrinsics are not finite, or a focal length is not positive"
            raise InputError(problem, remedy="Correct the file.", **where)
        lens = Lens(
            fx_px=fx,
            fy_px=fy,
            # The file counts from the centre of the first pixel.
            cx_px=cx + PIXEL_CENTRE,
            cy_px=cy + PIXEL_CENTRE,
            width_px=size[0],
            height_px=size[1],
        )
        return Camera(name, with_distortion(lens, intrinsics, **where), readout_s, exposure_s)

    def _read_image_size(self, camera: str) -> tuple[int, int] | None:
        """Width and height from the header of the first image that has one."""
        from PIL import Image

        for frame in range(self.frame_count):
            path = self._find_image(camera, frame)
            if path is None:
                continue
            try:
                with Image.open(path) as image:
                    return image.size
            except (OSError, ValueError):
                # `check` reports an unreadable image; another one has the size.
                continue
        return None

    @cached_property
    def _camera_poses_and_times(self) -> dict[str, tuple[list[object], Float64]]:
        """Camera → entries of its ``poses.json``, and [F] seconds."""
        rows = {}
        for camera in self.cameras:
            folder = f"camera/{camera.name}"
            poses = self._read_list(f"{folder}/poses.json")
            self._check_length(len(poses), f"{folder}/poses.json")
            rows[camera.name] = (poses, self._read_times(f"{folder}/timestamps.json"))
        return rows

    def _poses_and_times(self, camera: str, frame: int) -> tuple[list[object], Float64]:
        """The poses and times of a camera; ``frame`` is for the error."""
        known = self._camera_poses_and_times
        if camera not in known:
            remedy = f"{did_you_mean(camera, known)}The log has {', '.join(known) or 'no camera'}."
            raise InputError("no such camera", remedy=remedy, log=self.uri, camera=camera, frame=frame)
        return known[camera]

    def frame_timestamp_s(self, frame: int) -> float:
        """See ``DrivingLog``."""
        return float(self._lidar_times[self._check_frame(frame)])

    def world_SE3_lidar(self, frame: int) -> Float64:
        """See ``DrivingLog``; the file's x right, y forward, z up is turned to x forward, y left, z up.

        Raises:
            InputError: no such frame, or the recorded pose is not finite.
        """
        pose = self._lidar_poses[self._check_frame(frame)]
        return to_flu_axes(parse_pose(pose, file=self.folder / "lidar/poses.json", log=self.uri, frame=frame))

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """See ``DrivingLog``; PandaSet's camera axes are x right, y down, z forward too.

        Raises:
            InputError: no such camera or frame, or the recorded pose is not finite.
        """
        poses, _ = self._poses_and_times(camera, frame)
        pose = poses[self._check_frame(frame)]
        file = self.folder / "camera" / camera / "poses.json"
        return parse_pose(pose, file=file, log=self.uri, frame=frame, camera=camera)

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """See ``DrivingLog``."""
        _, times = self._poses_and_times(camera, frame)
        return float(times[self._check_frame(frame)])

    def _find_image(self, camera: str, frame: int) -> Path | None:
        stem = self.folder / "camera" / camera / frame_stem(frame)
        paths = (stem.with_name(stem.name + suffix) for suffix in IMAGE_SUFFIXES)
        return next((path for path in paths if path.is_file()), None)

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """See ``DrivingLog``.

        Raises:
            InputError: no such camera or frame.
        """
        self._poses_and_times(camera, frame)
        path = self._find_image(camera, self._check_frame(frame))
        return None if path is None else path.read_bytes()

    def sweep(self, frame: int) -> Sweep | None:
        """See ``DrivingLog``; points of the forward LiDAR, and points that are not finite, are left out.

        Raises:
            InputError: no such frame, or a sweep that cannot be read.
        """
        path = self.folder / "lidar" / f"{frame_stem(self._check_frame(frame))}.pkl.gz"
        # A sequence may lack sweeps: real ones do.
        if not path.is_file():
            return None
        where: dict[str, Any] = {"file": path, "log": self.uri, "frame": frame}
        table = read_table(path, log=self.uri, frame=frame)
        missing = [name for name in ("x", "y", "z", "i", "t") if name not in table.columns]
        if missing:
            problem = f"the sweep lacks the columns {', '.join(missing)}"
            raise InputError(problem, remedy="Copy it again.", **where)
        try:
            # Columns may be integers or float32; world coordinates need float64.
            rows = np.stack([table.columns[name].astype(np.float64) for name in "xyzit"], axis=1)
        except (TypeError, ValueError) as error:
            problem = f"a column of the sweep is not numeric ({error})"
            raise InputError(problem, remedy="Copy it again.", **where) from error
        return self._build_sweep(rows, table, frame)

    def _build_sweep(self, rows: Float64, table: Table, frame: int) -> Sweep:
        """The sweep of [N, 5] rows x, y, z, intensity, time."""
        if "d" in table.columns:
            rows = rows[table.columns["d"] == SPINNING_SENSOR]
        finite = np.isfinite(rows).all(axis=1)
        if not finite.all():
            count = int((~finite).sum())
            message = f"{count} points of sweep {frame} are not finite and left out"
            self._report(Finding("invalid_points", "warning", message, numbers={"points": count}, frames=(frame,)))
            rows = rows[finite]
        return Sweep(
            # Copies, or the few columns that are used would keep the rows of the file in memory.
            points_world=np.ascontiguousarray(rows[:, :3]),
            intensity=np.clip(rows[:, 3] / INTENSITY_SCALE, 0.0, 1.0).astype(np.float32),
            timestamps_s=convert_to_seconds(rows[:, 4].copy()),
        )

    @cached_property
    def _tracks(self) -> tuple[CuboidTrack, ...]:
        tracks, findings = build_tracks(self._read_cuboids())
        for finding in findings:
            self._report(finding)
        return tracks

    def _read_cuboids(self) -> Iterator[tuple[int, Table]]:
        for frame in range(self.frame_count):
            path = self.folder / "annotations/cuboids" / f"{frame_stem(frame)}.pkl.gz"
            if path.is_file():
                yield frame, read_table(path, log=self.uri, frame=frame)

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """See ``DrivingLog``; an object that both LiDARs saw is one track.

        Raises:
            InputError: the cuboids of a frame cannot be read.
        """
        return self._tracks

    def _report(self, finding: Finding) -> None:
        # By message, since a sweep that is read twice must count once.
        self._findings[finding.message] = finding

    def findings(self) -> tuple[Finding, ...]:
        """What cameras and tracks, and the sweeps read so far, had to leave out.

        Returns:
            One entry per thing left out.
        """
        _ = self.cameras, self._tracks
        return tuple(self._findings.values())

    def digest(self) -> str:
        """Identifies the name, size and content of every file of cameras, LiDAR and cuboids, in name order.

        Returns:
            sha256, hexadecimal; the folder's own path does not count.
        """
        paths = (path for pattern in _DIGESTED_FILES for path in self.folder.glob(pattern))
        files = sorted((path.relative_to(self.folder).as_posix(), path) for path in paths)
        total = hashlib.sha256()
        for name, path in files:
            if path.is_file():
                # Lengths and separators keep two different sequences from giving the same stream of bytes.
                total.update(f"{name}\0{path.stat().st_size}\0{_hash_file(path)}\n".encode())
        return total.hexdigest()


# A sequence has gigabytes, and its digest is asked for again and again.
_FILE_HASHES: dict[tuple[str, int, int], str] = {}


def _hash_file(path: Path) -> str:
    """sha256 of a file, remembered in this process by path, size and time of change."""
    stat = path.stat()
    key = (str(path.resolve()), stat.st_size, stat.st_mtime_ns)
    if key not in _FILE_HASHES:
        with path.open("rb") as file:
            _FILE_HASHES[key] = hashlib.file_digest(file, "sha256").hexdigest()
    return _FILE_HASHES[key]
