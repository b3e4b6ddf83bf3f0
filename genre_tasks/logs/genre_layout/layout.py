"""The names and numbers of the layout, as its reader and its writer share them.

``log.json``::

    {"format": "genre-log", "version": 1,
     "cameras": {"front": {"fx_px": …, "fy_px": …, "cx_px": …, "cy_px": …, "width_px": …, "height_px": …}},
     "frames": [{"time_s": …, "lidar_pose": POSE, "sweep": "lidar/000000.npz",
                 "lidar_position": [X, Y, Z],
                 "images": {"front": {"file": "images/front/000000.jpg", "pose": POSE, "time_s": …}}}]}

POSE is a 4×4 matrix, row by row, that takes the sensor's axes to the world's. The position is needed where the pose is
not the LiDAR's own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Float64
from genre_tasks.suggestions import did_you_mean

LOG_FILE = "log.json"
FORMAT = "genre-log"
VERSION = 1
BOXES_FILE = "boxes.parquet"
LENS_KEYS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
LOG_KEYS = ("format", "version", "cameras", "frames")
CAMERA_KEYS = (*LENS_KEYS, "distortion", "readout_s", "exposure_s")
FRAME_KEYS = ("time_s", "lidar_pose", "lidar_position", "sweep", "images")
IMAGE_KEYS = ("file", "pose", "time_s")
POINT_COLUMNS = ("x", "y", "z", "intensity", "time_s")
BOX_COLUMNS = (
    "track_id",
    "label",
    "frame",
    "moving",
    "x",
    "y",
    "z",
    "qw",
    "qx",
    "qy",
    "qz",
    "length",
    "width",
    "height",
)

_MOST_UNKNOWN_KEYS = 50
_LONGEST_KEY = 80
_ROTATION_TOLERANCE = 1e-3
# The Earth is 4e7 m around.
_MAX_POSITION_M = 1e12


class EntryError(ValueError):
    """A value of ``log.json`` is not what the layout has there."""


def parse_pose(value: object, what: str) -> Float64:
    """Reads a pose.

    Args:
        value: 4×4 numbers, row by row.
        what: it is, for the error.

    Returns:
        [4, 4] float64, as it stands in the file where its rotation is one to nine digits.

    Raises:
        EntryError: it is no matrix of a rotation and a position.
    """
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise EntryError(f"{what} is no matrix of 4×4 finite numbers")
    # A scale or a shear would bend everything that is placed by it.
    rotation = matrix[:3, :3]
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if not (matrix[3] == [0, 0, 0, 1]).all() or error > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise EntryError(f"{what} is no rotation with a position: its last row must be 0, 0, 0, 1")
    parse_position(matrix[:3, 3], f"the position of {what}")
    # Files of others are rounded to a few digits; what this project wrote is left as it is.
    if error > 1e-9:
        u, _, v = np.linalg.svd(rotation)
        matrix[:3, :3] = u @ v
    return matrix


def parse_position(value: object, what: str) -> Float64 | None:
    """Reads a position.

    Args:
        value: three numbers in metres; ``None`` where nothing is stated.
        what: it is, for the error.

    Returns:
        [3] float64, or ``None``.

    Raises:
        EntryError: it is no list of three finite numbers near the Earth.

    >>> parse_position([1, 2, 3], "x").tolist()
    [1.0, 2.0, 3.0]
    """
    if value is None:
        return None
    try:
        position = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        position = np.zeros(0)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise EntryError(f"{what} is no list of three finite numbers")
    if np.abs(position).max() > _MAX_POSITION_M:
        raise EntryError(f"{what} is beyond the Earth")
    return position


def parse_number(values: Mapping[str, Any], key: str, what: str, default: float | None = None) -> float:
    """Reads a finite number.

    Args:
        values: that the key is in.
        key: of the number.
        what: the values are, for the error.
        default: for a missing key; ``None``: it must be there.

    Returns:
        The number.

    Raises:
        EntryError: it is missing, or no finite number.

    >>> parse_number({"a": 2}, "a", "x"), parse_number({}, "a", "x", 0.5)
    (2.0, 0.5)
    """
    value = values.get(key, default)
    # A bool is an int of Python.
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    try:
        number = float(value) if is_number and value is not None else math.nan
    except OverflowError:
        number = math.nan
    if not math.isfinite(number):
        raise EntryError(f"{what} has no finite number {key}")
    return number


def parse_mapping(value: object, what: str) -> Mapping[str, Any]:
    """Checks that a value is an object of JSON.

    Args:
        value: to check.
        what: it is, for the error.

    Returns:
        The object.

    Raises:
        EntryError: it is none.
    """
    if not isinstance(value, dict):
        raise EntryError(f"{what} is no object")
    return value


def resolve_file(folder: Path, name: object, what: str) -> Path:
    """Finds a file of the log.

    Args:
        folder: of the log.
        name: relative to it, with ``/``.
        what: it is, for the error.

    Returns:
        The path, whether it exists or not.

    Raises:
        EntryError: it is no name, or leads out of the folder.
    """
    if not isinstance(name, str) or not name:
        raise EntryError(f"{what} names no file")
    # A log may come from anyone, and must not read files of others.
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\0" in name:
        raise EntryError(f"{what} leads out of the log's folder: {name!r}")
    return folder / path


def describe_entry_error(error: EntryError, file: Path, log: str) -> InputError:
    """Makes the error that a user reads.

    Args:
        error: of an entry.
        file: that it stands in.
        log: URI of the log.

    Returns:
        The error, which names the file and what the layout has.
    """
    remedy = "Correct the file; the guide of the genre layout lists every key."
    return InputError(str(error), remedy=remedy, file=file, log=log)


def find_unknown_keys(values: Mapping[str, Any]) -> list[Finding]:
    """Finds keys that the layout does not know: a misspelt one leaves out what it was to say.

    Args:
        values: of ``log.json``, its cameras and frames checked to be objects.

    Returns:
        A finding for each key and kind of place, a warning where it is near a known one; the first
        ``_MOST_UNKNOWN_KEYS``.

    >>> (found,) = find_unknown_keys({"cameras": {"front": {"readout": 0.03}}, "frames": []})
    >>> found.message, found.remedy
    ("log.json has the key 'readout' at camera front, which means nothing", "Did you mean 'readout_s'?")
    """
    cameras = values["cameras"]
    unknown: dict[tuple[str, tuple[str, ...]], str] = {}

    def look(entry: object, known: tuple[str, ...], what: str) -> None:
        for key in entry if isinstance(entry, dict) else ():
            if key not in known:
                unknown.setdefault((str(key), known), what)

    look(values, LOG_KEYS, "the top")
    for name, camera in cameras.items():
        look(camera, CAMERA_KEYS, f"camera {name}")
    for index, frame in enumerate(values["frames"]):
        look(frame, FRAME_KEYS, f"frame {index}")
        images = frame.get("images")
        look(images, tuple(cameras), f"the images of frame {index}")
        for name, image in images.items() if isinstance(images, dict) else ():
            look(image, IMAGE_KEYS, f"the image of {name} in frame {index}")
    findings = []
    # A damaged file may have millions of keys, or one of megabytes.
    for (key, known), what in itertools.islice(unknown.items(), _MOST_UNKNOWN_KEYS):
        message = f"{LOG_FILE} has the key {key[:_LONGEST_KEY]!r} at {what}, which means nothing"
        hint = did_you_mean(key[:_LONGEST_KEY], known).strip()
        remedy = hint or f"The keys there are {', '.join(known)}."
        findings.append(Finding("unknown_key", "warning" if hint else "note", message, remedy))
    return findings
