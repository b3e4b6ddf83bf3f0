"""Paths of the ego vehicle in files that users write: Parquet or JSON.

A file has a row for each pose. Its columns:

==================  ===================================================================================
``time_s``          seconds since the first recorded pose, rising
``frame``           log frame, or a moment between two: where the traffic is; with ``time_s``, either may be left out
``x, y, z``         metres in the log's world
``qw, qx, qy, qz``  unit quaternion from the vehicle's axes (x forward, y left, z up) to the world
==================  ===================================================================================

Instead of the last two lines, ``lateral_m`` and ``ahead_m`` place poses relative to the recorded path. JSON is a list
of objects, one for each row, or an object whose ``poses`` are that list. The ``poses.parquet`` of a rollout is such
a file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from genre_tasks.bounded_parquet import FOR_ROWS, read_bounded_table
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.relative_path import place_relative_path
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64
from genre_tasks.suggestions import did_you_mean

POSE_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")
RELATIVE_COLUMNS = ("lateral_m", "ahead_m")
TIME_COLUMNS = ("time_s", "frame")
MARK_COLUMNS = (
    *("index", "reliable", "outside_recording"),
    *("chunk", "blended_chunk", "blend_weight", "collision"),
)
"""What a rollout writes next to its poses; a path that is read has marks of its own."""

_COLUMNS = (*TIME_COLUMNS, *POSE_COLUMNS, *RELATIVE_COLUMNS)
# Of a moment from the nearest frame of a chunk, in frames.
_FURTHEST_FRAME = 0.5
# A drive through the log in so many times its time is meant in other units.
_SLOWEST = 100.0
_LEAST_STEP_S = 0.001
_QUATERNION_TOLERANCE = 0.01
# Farther away than any detour: coordinates of another origin.
_FARTHEST_M = 1000.0
_REMEDY = f"A path has time_s or frame, and {', '.join(POSE_COLUMNS)} or {' and '.join(RELATIVE_COLUMNS)}."


def read_path_file(path: Path, recorded: EgoPath) -> EgoPath:
    """Reads a path of the ego vehicle from a file.

    Args:
        path: a Parquet or JSON file, see the module.
        recorded: one pose for each log frame.

    Returns:
        The path.

    Raises:
        InputError: the file is unreadable or holds no path, with the row and the remedy.
    """
    if not len(recorded):
        raise InputError("a path without frames: the recorded path has 0 poses", remedy="Take at least one chunk.")
    try:
        columns = _read_columns(path)
        if not columns or not len(next(iter(columns.values()))):
            raise InputError("a path without frames: the file has 0 rows", remedy="Write a row for each pose.")
        _check_columns(columns)
        numbers = {name: _read_numbers(name, columns[name]) for name in _COLUMNS if name in columns}
        times, frames = _place_in_time(numbers, recorded)
        if "x" not in numbers:
            return place_relative_path(recorded, times, frames, numbers["lateral_m"], numbers["ahead_m"])
        return EgoPath(times - times[0], frames, _read_poses(numbers, recorded))
    except InputError as error:
        # The file is known here alone; every other function works on its rows.
        raise InputError(error.problem, remedy=error.remedy, file=path) from error


def tabulate_path(path: EgoPath) -> dict[str, Float64]:
    """Writes a path as the columns of such a file.

    Args:
        path: any path.

    Returns:
        Columns by name: ``time_s``, ``frame`` and ``POSE_COLUMNS``.

    >>> list(tabulate_path(EgoPath(np.zeros(1), np.zeros(1), np.eye(4)[None])))
    ['time_s', 'frame', 'x', 'y', 'z', 'qw', 'qx', 'qy', 'qz']
    """
    position = path.world_SE3_ego[:, :3, 3]
    quaternion = Rotation.from_matrix(path.world_SE3_ego[:, :3, :3]).as_quat(canonical=True, scalar_first=True)
    values = np.concatenate([position, quaternion], axis=1)
    columns = {name: values[:, k] for k, name in enumerate(POSE_COLUMNS)}
    return {"time_s": path.times_s, "frame": path.frames, **columns}


def _read_columns(path: Path) -> Mapping[str, Sequence[Any]]:
    kind = path.suffix.lower()
    if kind not in (".parquet", ".json"):
        raise InputError("a path is a .parquet or a .json file", remedy="Give the file one of these endings.")
    try:
        if kind == ".parquet":
            table = read_bounded_table(path, FOR_ROWS)
            return {name: table.column(name).to_pylist() for name in table.column_names}
        rows = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError, pa.ArrowException) as error:
        raise InputError(f"the path cannot be read: {error}", remedy="Check the file's name and content.") from error
    if isinstance(rows, dict) and set(rows) == {"poses"}:
        rows = rows["poses"]
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError("the JSON is no list of objects", remedy='Write [{"frame": 0, "lateral_m": 3, …}, …].')
    names = list(rows[0]) if rows else []
    for number, row in enumerate(rows):
        if set(row) != set(names):
            odd = sorted(set(row) ^ set(names))[0]
            raise InputError(
                f"row {number} (from 0) and row 0 differ: one of them alone has {odd!r}",
                remedy="Write the same columns in all rows.",
            )
    return {name: [row[name] for row in rows] for name in names}


def _check_columns(columns: Mapping[str, Sequence[Any]]) -> None:
    """Refuses unknown and missing columns."""
    for name in columns:
        if name not in _COLUMNS and name not in MARK_COLUMNS:
            raise InputError(f"unknown column {name!r}", remedy=did_you_mean(name, _COLUMNS) + _REMEDY)
    if not set(TIME_COLUMNS) & set(columns):
        raise InputError("the path has neither time_s nor frame", remedy=_REMEDY)
    wanted = POSE_COLUMNS if set(POSE_COLUMNS) & set(columns) else RELATIVE_COLUMNS
    missing = [name for name in wanted if name not in columns]
    if missing:
        raise InputError(f"the path has no column {', '.join(missing)}", remedy=_REMEDY)


def _read_numbers(name: str, values: Sequence[Any]) -> Float64:
    for row, value in enumerate(values):
        # A bool is an int in Python, and would be read as 0 or 1.
        if isinstance(value, bool) or not isinstance(value, int | float) or not _is_finite(value):
            raise InputError(f"{name} is {value!r} in row {row} (from 0)", remedy="Write a finite number.")
    return np.array(values, np.float64)


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def _place_in_time(numbers: Mapping[str, Float64], recorded: EgoPath) -> tuple[Float64, Float64]:
    """Times and frames [P]; where one is missing, the recorded path tells it from the other."""
    recorded_s = recorded.times_s - recorded.times_s[0]
    if "frame" in numbers:
        frames = numbers["frame"]
        distance = np.abs(frames[:, None] - recorded.frames).min(axis=1)
        outside = (distance > _FURTHEST_FRAME) | (frames < recorded.frames[0]) | (frames > recorded.frames[-1])
        _refuse_rows(outside, "frame", frames, f"the log's frames {recorded.frames[0]:g} to {recorded.frames[-1]:g}")
        _refuse_order(np.diff(frames) < 0, "frame", frames, "Traffic goes forward in time: let no frame fall.")
    if "time_s" in numbers:
        times = numbers["time_s"]
        _refuse_order(np.diff(times) < _LEAST_STEP_S, "time_s", times, "Let times rise, by a millisecond or more.")
        if "frame" not in numbers:
            # A millisecond more than the log has is rounding.
            outside = (times < -_LEAST_STEP_S) | (times > recorded_s[-1] + _LEAST_STEP_S)
            _refuse_rows(outside, "time_s", times, f"the log's 0 to {recorded_s[-1]:.2f} s")
            frames = np.interp(times, recorded_s, recorded.frames)
            apart = np.abs(frames[:, None] - recorded.frames).min(axis=1) > _FURTHEST_FRAME
            _refuse_rows(apart, "time_s", times, "the chunks, which do not follow each other")
        elif times[-1] - times[0] > _SLOWEST * (recorded_s[-1] + 1):
            problem = f"time_s spans {times[-1] - times[0]:g} s, and the log {recorded_s[-1]:.2f} s"
            raise InputError(problem, remedy="Write time_s in seconds.")
    else:
        times = np.interp(frames, recorded.frames, recorded_s)
        _refuse_order(np.diff(times) < _LEAST_STEP_S, "frame", frames, "Let frames rise, or state time_s as well.")
    return times, frames


def _refuse_rows(bad: Any, name: str, values: Float64, expected: str) -> None:
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"{name} {values[row]:g} in row {row} (from 0) is outside of {expected}",
            remedy="Leave such rows out, or take more chunks of the run.",
        )


def _refuse_order(bad: Any, name: str, values: Float64, remedy: str) -> None:
    if bad.any():
        row = int(np.argmax(bad)) + 1
        raise InputError(f"{name} {values[row]:g} in row {row} (from 0) follows {values[row - 1]:g}", remedy=remedy)


def _read_poses(numbers: Mapping[str, Float64], recorded: EgoPath) -> Float64:
    quaternions = np.stack([numbers[name] for name in ("qw", "qx", "qy", "qz")], axis=1)
    lengths = np.linalg.norm(quaternions, axis=1)
    bad = np.abs(lengths - 1) > _QUATERNION_TOLERANCE
    if bad.any():
        row = int(np.argmax(bad))
        problem = f"the quaternion in row {row} (from 0) has the length {lengths[row]:.3g}"
        raise InputError(problem, remedy="Write unit quaternions; qw=1 and 0 elsewhere points along the world's x.")
    positions = np.stack([numbers[name] for name in ("x", "y", "z")], axis=1)
    offset = positions[:, None, :2] - recorded.world_SE3_ego[:, :2, 3]
    distance = np.sqrt(np.square(offset).sum(-1).min(axis=1))
    if distance.max() > _FARTHEST_M:
        row = int(np.argmax(distance > _FARTHEST_M))
        raise InputError(
            f"row {row} (from 0) is {distance[row] / 1000:.1f} km away from the recorded path",
            remedy="Write positions in the log's world, as the poses of a rollout are.",
        )
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    poses[:, :3, 3] = positions
    return poses
