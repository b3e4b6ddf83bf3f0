"""Where the files of a KITTI drive lie, and the small text files among them as numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.file_reading import read_file
from genre_tasks.logs.types import Float64

CALIBRATION_FILES = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
TRACKLETS_FILE = "tracklet_labels.xml"
COLOUR_CAMERAS = ("image_02", "image_03")
GREY_CAMERAS = ("image_00", "image_01")

_FRAME_NUMBER = re.compile(r"[0-9]{10}")
_IMAGE_SUFFIXES = (".png", ".jpg")
_SWEEP_SUFFIXES = (".bin",)
_TEXT_SUFFIXES = (".txt",)
_COPY_REMEDY = "Unpack the drive and the calibration of its day again, into KITTI's folders."
# A file of one day's calibration has thirty lines.
_MAX_TEXT_BYTES = 1 << 24
_NANOSECONDS = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d+)?")


@dataclass(frozen=True)
class DriveFiles:
    """The files of a drive.

    Attributes:
        folder: of the drive, such as ``2011_09_26_drive_0009_sync``.
        day: the folder above it, with the calibration.
        cameras: name → frame → image.
        sweeps: frame → file of the LiDAR.
        poses: frame → file of the inertial navigation ("oxts").
    """

    folder: Path
    day: Path
    cameras: Mapping[str, Mapping[int, Path]]
    sweeps: Mapping[int, Path]
    poses: Mapping[int, Path]

    def times_file(self, sensor: str, name: str = "timestamps.txt") -> Path:
        """Names a file of times.

        Args:
            sensor: folder of the sensor, such as ``oxts``.
            name: of the file.

        Returns:
            The path, whether it exists or not.
        """
        return self.folder / sensor / name

    def list_read_files(self) -> list[Path]:
        """Lists the files that the reader reads.

        Returns:
            The files, in no particular order; files of times only where they exist.
        """
        sensors = (*self.cameras, "oxts", "velodyne_points")
        names = ("timestamps.txt", "timestamps_start.txt", "timestamps_end.txt")
        times = [self.times_file(sensor, name) for sensor in sensors for name in names]
        others = [*(self.day / name for name in CALIBRATION_FILES), self.folder / TRACKLETS_FILE, *times]
        found = [path for path in others if path.is_file()]
        for files in (*self.cameras.values(), self.sweeps, self.poses):
            found += files.values()
        return found


def find_drive_files(folder: Path, log: str) -> DriveFiles:
    """Lists the files of a drive.

    Args:
        folder: of the drive.
        log: URI of the log, for errors.

    Returns:
        The files. Grey cameras are listed only where there is no colour camera.

    Raises:
        InputError: it is no folder of a drive, or its sweeps are text.
    """
    remedy = "Give the folder of one drive, as in kitti:PATH/2011_09_26/2011_09_26_drive_0009_sync."
    # A link to a drive lies beside no calibration.
    folder = folder.resolve()
    if not folder.is_dir():
        raise InputError("there is no such folder of a drive", remedy=remedy, file=folder, log=log)
    missing = [name for name in ("oxts", "velodyne_points") if not (folder / name).is_dir()]
    if missing:
        drives = sorted(path.parent.name for path in folder.glob("*/oxts"))
        if drives:
            remedy += f" Drives in it: {', '.join(drives[:10])}."
        raise InputError(f"no KITTI drive here: no {' and no '.join(missing)}", remedy=remedy, file=folder, log=log)
    cameras = {name: _list_frames(folder / name / "data", _IMAGE_SUFFIXES) for name in COLOUR_CAMERAS}
    if not any(cameras.values()):
        cameras = {name: _list_frames(folder / name / "data", _IMAGE_SUFFIXES) for name in GREY_CAMERAS}
    cameras = {name: files for name, files in cameras.items() if files}
    if not cameras:
        problem = f"there are no images in {', '.join((*COLOUR_CAMERAS, *GREY_CAMERAS))}"
        raise InputError(problem, remedy=_COPY_REMEDY, file=folder, log=log)
    return DriveFiles(
        folder=folder,
        day=folder.parent,
        cameras=cameras,
        sweeps=_list_sweeps(folder / "velodyne_points/data", log),
        poses=_list_frames(folder / "oxts/data", _TEXT_SUFFIXES),
    )


def _list_sweeps(folder: Path, log: str) -> dict[int, Path]:
    sweeps = _list_frames(folder, _SWEEP_SUFFIXES)
    # Bytes of text would be read as floats, and some lengths fit.
    as_text = [path for frame, path in _list_frames(folder, _TEXT_SUFFIXES).items() if frame not in sweeps]
    if as_text:
        problem = f"{len(as_text)} sweeps are text, as in an unsynced drive"
        raise InputError(problem, remedy="Take the drive whose name ends in _sync.", file=as_text[0], log=log)
    return sweeps


def _list_frames(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    if not folder.is_dir():
        return {}
    paths = (path for path in sorted(folder.iterdir()) if path.suffix in suffixes)
    return {int(path.stem): path for path in paths if _FRAME_NUMBER.fullmatch(path.stem)}


def read_text(path: Path, log: str, frame: int | None = None) -> str:
    """Reads a small text file.

    Args:
        path: the file.
        log: URI of the log, for errors.
        frame: log frame, for errors.

    Returns:
        Its text.

    Raises:
        InputError: the file is missing, unreadable, too large, or no text.
    """
    if path.is_file() and path.stat().st_size > _MAX_TEXT_BYTES:
        problem = f"the file has {path.stat().st_size} bytes; KITTI's text files have a few kilobytes"
        raise InputError(problem, remedy=_COPY_REMEDY, file=path, log=log, frame=frame)
    try:
        return read_file(path, log=log, frame=frame).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        problem = f"the file is no text ({error})"
        raise InputError(problem, remedy=_COPY_REMEDY, file=path, log=log, frame=frame) from error


def read_calibration(
    path: Path, needed: Mapping[str, int], log: str, optional: Mapping[str, int] | None = None
) -> dict[str, Float64]:
    """Reads a file of lines ``NAME: numbers``.

    Args:
        path: the file.
        needed: name → how many numbers it has.
        log: URI of the log, for errors.
        optional: the same, of names that may be missing.

    Returns:
        Name → numbers, of the needed names and of those of the others that are there.

    Raises:
        InputError: a needed name is missing, or a name has other numbers.
    """
    lines = dict(line.partition(":")[::2] for line in read_text(path, log).splitlines())
    found = {}
    for name, count in {**(optional or {}), **needed}.items():
        if name in lines:
            found[name] = parse_numbers(lines[name], count, name, path, log)
        elif name in needed:
            raise InputError(f"the calibration lacks {name}", remedy=_COPY_REMEDY, file=path, log=log)
    return found


def parse_numbers(
    text: str, count: int, what: str, path: Path, log: str, frame: int | None = None, unchecked: bool = False
) -> Float64:
    """Reads numbers with spaces between them.

    Args:
        text: of the numbers.
        count: how many are needed; more may follow.
        what: they are, for errors.
        path: the file, for errors.
        log: URI of the log, for errors.
        frame: log frame, for errors.
        unchecked: whether they may be infinite or NaN.

    Returns:
        [count] numbers.

    Raises:
        InputError: there are fewer, or one is not finite and that is not allowed.
    """
    words = text.split()[:count]
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"{what}: {error}", remedy=_COPY_REMEDY, file=path, log=log, frame=frame) from error
    if len(numbers) < count or not (unchecked or np.isfinite(numbers).all()):
        problem = f"{what} has {len(numbers)} numbers, not {count}{'' if unchecked else ' finite ones'}"
        raise InputError(problem, remedy=_COPY_REMEDY, file=path, log=log, frame=frame)
    return numbers


def read_times(path: Path, log: str) -> Float64:
    """Reads a file of times, a line a frame.

    Args:
        path: the file.
        log: URI of the log, for errors.

    Returns:
        [F] seconds since 1970; KITTI's clock is taken for UTC. NaN for an empty line, which is a frame without data.

    Raises:
        InputError: a line is no time.
    """
    times = []
    for number, line in enumerate(read_text(path, log).rstrip().splitlines()):
        match = _NANOSECONDS.fullmatch(line.strip())
        if match is None and line.strip():
            problem = f"line {number + 1} is no time: {line.strip()[:40]!r}"
            raise InputError(problem, remedy=_COPY_REMEDY, file=path, log=log, frame=number)
        times.append(np.nan if match is None else _parse_time(match, number, path, log))
    return np.array(times, dtype=np.float64)


def _parse_time(match: re.Match[str], number: int, path: Path, log: str) -> float:
    try:
        second = datetime.strptime(match[1], "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError as error:
        raise InputError(
            f"line {number + 1} is no time ({error})", remedy=_COPY_REMEDY, file=path, log=log, frame=number
        ) from error
    # datetime knows microseconds only.
    return second.timestamp() + float(match[2] or 0.0)
