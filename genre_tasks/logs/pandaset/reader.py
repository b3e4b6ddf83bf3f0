"""Reader of the PandaSet layout: ``pandaset:PATH/002``."""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.pandaset.cuboids import tracks_of_cuboids
from genre_tasks.logs.pandaset.layout import (
    IMAGE_SUFFIXES,
    INTENSITY_SCALE,
    PIXEL_CENTRE,
    READOUT_S,
    RIG_ORDER,
    SPINNING_SENSOR,
    frame_stem,
    pose_matrix,
    read_json,
    seconds,
    to_our_axes,
)
from genre_tasks.logs.pandaset.pickle_reader import Frame, read_frame
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Lens, LogProblem, Sweep, Truth

_NEEDED = ("lidar/poses.json", "lidar/timestamps.json")


def open_pandaset(rest: str) -> PandaSetLog:
    """Opens the sequence folder ``rest``.

    Raises:
        InputError: no such folder, or no sequence in it (names what was looked for).
    """
    folder, uri = Path(rest).expanduser(), f"pandaset:{rest}"
    if not rest or not folder.is_dir():
        remedy = "Give the folder of one sequence, as in pandaset:PATH/002."
        raise InputError("there is no such sequence folder", remedy=remedy, file=folder, log=uri)
    missing = [name for name in _NEEDED if not (folder / name).is_file()]
    if missing:
        inside = sorted(p.parent.parent.name for p in folder.glob("*/lidar/poses.json"))
        hint = f" Sequences in it: {', '.join(inside[:10])}." if inside else ""
        remedy = f"Give the folder of one sequence, as in pandaset:PATH/002.{hint}"
        raise InputError(
            f"no PandaSet sequence here: no {' and no '.join(missing)}", remedy=remedy, file=folder, log=uri
        )
    return PandaSetLog(uri, folder)


class PandaSetLog:
    """A ``DrivingLog`` (see there for units and axes) over a PandaSet sequence folder; the world is PandaSet's own.

    Only the spinning 64-beam LiDAR is read (``d == 0``). Timestamps keep the files' order; see ``seconds`` for units.
    """

    dataset = "pandaset"
    truth: Truth | None = None

    def __init__(self, uri: str, folder: Path) -> None:
        self.uri = uri
        self.folder = folder
        self.name = folder.resolve().name
        self._lidar_poses = self._entries(folder / "lidar/poses.json")
        self._lidar_times = seconds(np.array(self._entries(folder / "lidar/timestamps.json"), dtype=np.float64))
        self.frame_count = len(self._lidar_poses)
        self._same_length(len(self._lidar_times), folder / "lidar/timestamps.json")
        self._problems: dict[str, LogProblem] = {}

    def _entries(self, path: Path) -> list[object]:
        entries = read_json(path, self.uri)
        if not isinstance(entries, list) or not entries:
            raise InputError(
                "a list of one entry a frame was expected", remedy="Copy it again.", file=path, log=self.uri
            )
        return entries

    def _same_length(self, count: int, path: Path) -> None:
        if count != self.frame_count:
            problem = f"{count} entries, but lidar/poses.json has {self.frame_count} frames"
            raise InputError(problem, remedy="Copy the whole sequence folder again.", file=path, log=self.uri)

    def _checked(self, frame: int) -> int:
        if not 0 <= frame < self.frame_count:
            remedy = f"The log has frames 0 to {self.frame_count - 1}."
            raise InputError("no such frame", remedy=remedy, log=self.uri, frame=frame)
        return frame

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """In rig order: front, front left, front right, left, right, back; then any others by name."""
        found = {p.parent.name for p in (self.folder / "camera").glob("*/intrinsics.json")}
        names = [name for name in RIG_ORDER if name in found] + sorted(found.difference(RIG_ORDER))
        cameras = [self._camera(name) for name in names]
        return tuple(camera for camera in cameras if camera is not None)

    def _camera(self, name: str) -> Camera | None:
        path = self.folder / "camera" / name / "intrinsics.json"
        given = read_json(path, self.uri)
        size = self._native_size(name)
        if size is None:
            self._note("camera_without_images", f"{name} has no readable image and is left out")
            return None
        try:
            fx, fy, cx, cy = (float(given[key]) for key in ("fx", "fy", "cx", "cy"))
            readout_s = float(given.get("readout_s", READOUT_S))
            exposure_s = float(given.get("exposure_s", 0.0))
            distortion = tuple(float(k) for k in given.get("distortion", ()))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            problem = f"fx, fy, cx, cy were expected ({error!r})"
            raise InputError(problem, remedy="Copy it again.", file=path, log=self.uri, camera=name) from error
        if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
            problem = "the intrinsics are not finite, or a focal length is not positive"
            raise InputError(problem, remedy="Correct the file.", file=path, log=self.uri, camera=name)
        return Camera(
            name, Lens(fx, fy, cx + PIXEL_CENTRE, cy + PIXEL_CENTRE, *size, distortion), readout_s, exposure_s
        )

    def _native_size(self, camera: str) -> tuple[int, int] | None:
        """Width and height from the header of the first image that has one."""
        from PIL import Image

        for frame in range(self.frame_count):
            path = self._image_path(camera, frame)
            if path is None:
                continue
            try:
                with Image.open(path) as image:
                    return image.size
            except (OSError, ValueError):  # unreadable: `check` reports it, another image has the size
                continue
        return None

    @cached_property
    def _camera_rows(self) -> dict[str, tuple[list[object], Float64]]:
        rows = {}
        for camera in self.cameras:
            folder = self.folder / "camera" / camera.name
            poses = self._entries(folder / "poses.json")
            times = seconds(np.array(self._entries(folder / "timestamps.json"), dtype=np.float64))
            self._same_length(len(poses), folder / "poses.json")
            self._same_length(len(times), folder / "timestamps.json")
            rows[camera.name] = (poses, times)
        return rows

    def _rows(self, camera: str, frame: int) -> tuple[list[object], Float64]:
        if camera not in self._camera_rows:
            close = difflib.get_close_matches(camera, self._camera_rows, n=1)
            question = f"Did you mean {close[0]!r}? " if close else ""
            remedy = f"{question}The log has {', '.join(self._camera_rows) or 'no camera'}."
            raise InputError("no such camera", remedy=remedy, log=self.uri, camera=camera, frame=frame)
        return self._camera_rows[camera]

    def frame_timestamp_s(self, frame: int) -> float:
        return float(self._lidar_times[self._checked(frame)])

    def world_SE3_lidar(self, frame: int) -> Float64:
        pose = self._lidar_poses[self._checked(frame)]
        return to_our_axes(pose_matrix(pose, file=self.folder / "lidar/poses.json", log=self.uri, frame=frame))

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        pose = self._rows(camera, frame)[0][self._checked(frame)]
        file = self.folder / "camera" / camera / "poses.json"
        return pose_matrix(pose, file=file, log=self.uri, frame=frame, camera=camera)

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        return float(self._rows(camera, frame)[1][self._checked(frame)])

    def _image_path(self, camera: str, frame: int) -> Path | None:
        stem = self.folder / "camera" / camera / frame_stem(frame)
        paths = (stem.with_name(stem.name + suffix) for suffix in IMAGE_SUFFIXES)
        return next((path for path in paths if path.is_file()), None)

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        self._rows(camera, frame)
        path = self._image_path(camera, self._checked(frame))
        return None if path is None else path.read_bytes()

    def sweep(self, frame: int) -> Sweep | None:
        path = self.folder / "lidar" / f"{frame_stem(self._checked(frame))}.pkl.gz"
        if not path.is_file():
            return None
        table = read_frame(path, log=self.uri, frame=frame)
        missing = [name for name in ("x", "y", "z", "i", "t") if name not in table.columns]
        if missing:
            problem = f"the sweep lacks the columns {', '.join(missing)}"
            raise InputError(problem, remedy="Copy it again.", file=path, log=self.uri, frame=frame)
        return self._sweep_of(table, frame, path)

    def _sweep_of(self, table: Frame, frame: int, path: Path) -> Sweep:
        column = table.columns
        try:
            rows = np.stack([column[name].astype(np.float64) for name in "xyzit"], axis=1)
        except (TypeError, ValueError) as error:
            problem = f"a column of the sweep is not numeric ({error})"
            raise InputError(problem, remedy="Copy it again.", file=path, log=self.uri, frame=frame) from error
        if "d" in column:
            rows = rows[column["d"] == SPINNING_SENSOR]
        finite = np.isfinite(rows).all(axis=1)
        if not finite.all():
            self._note("invalid_points", f"{int((~finite).sum())} points of sweep {frame} are not finite and left out")
            rows = rows[finite]
        intensity = np.clip(rows[:, 3] / INTENSITY_SCALE, 0.0, 1.0).astype(np.float32)
        return Sweep(np.ascontiguousarray(rows[:, :3]), intensity, seconds(rows[:, 4].copy()))

    @cached_property
    def _tracks(self) -> tuple[CuboidTrack, ...]:
        tracks, problems = tracks_of_cuboids(self._cuboids())
        for problem in problems:
            self._note(problem.kind, problem.message)
        return tracks

    def _cuboids(self) -> Iterator[tuple[int, Frame]]:
        for frame in range(self.frame_count):
            path = self.folder / "annotations/cuboids" / f"{frame_stem(frame)}.pkl.gz"
            if path.is_file():
                yield frame, read_frame(path, log=self.uri, frame=frame)

    def tracks(self) -> tuple[CuboidTrack, ...]:
        return self._tracks

    def _note(self, kind: str, message: str) -> None:
        self._problems[message] = LogProblem(kind, message)

    def problems(self) -> tuple[LogProblem, ...]:
        """What cameras and tracks, and the sweeps read so far, had to leave out."""
        _ = self.cameras, self._tracks
        return tuple(self._problems.values())

    def digest(self) -> str:
        """sha256 over relative name, size and content of every file of cameras, LiDAR and cuboids, in name order."""
        parts = ("camera/*/*", "lidar/*", "annotations/cuboids/*")
        files = sorted((p.relative_to(self.folder).as_posix(), p) for part in parts for p in self.folder.glob(part))
        total = hashlib.sha256()
        for name, path in files:
            if path.is_file():
                total.update(f"{name}\0{path.stat().st_size}\0{_file_sha256(path)}\n".encode())
        return total.hexdigest()


_DIGESTS: dict[tuple[str, int, int], str] = {}


def _file_sha256(path: Path) -> str:
    """Streamed, and remembered in this process by path, size and time of change."""
    stat = path.stat()
    key = (str(path.resolve()), stat.st_size, stat.st_mtime_ns)
    if key not in _DIGESTS:
        with path.open("rb") as file:
            _DIGESTS[key] = hashlib.file_digest(file, "sha256").hexdigest()
    return _DIGESTS[key]
