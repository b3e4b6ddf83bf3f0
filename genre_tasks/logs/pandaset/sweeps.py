"""PandaSet's sweeps: the table of a file becomes a ``Sweep``, and what was odd about it becomes findings."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.file_reading import convert_to_seconds
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.pandaset.layout import INTENSITY_SCALE, SPINNING_SENSOR
from genre_tasks.logs.pandaset.pickle_reader import Table
from genre_tasks.logs.point_values import fill_intensities, fill_point_times, find_placed_points
from genre_tasks.logs.types import Float64, Sweep

_COLUMNS = ("x", "y", "z", "i", "t")
_WIDE_INTENSITY_SCALE = 65535.0
_MAX_NAMES_LISTED = 12


def build_sweep(table: Table, frame: int, frame_time_s: float = 0.0, **where: Any) -> tuple[Sweep, list[Finding]]:
    """Builds the sweep of a frame from its table.

    Points of the forward LiDAR, and points without a finite place, are left out. Where all points are of other sensors
    than the spinning one, they are used. Intensities may be 0 to 255 as in PandaSet, 0 to 1, or 0 to 65535.

    Args:
        table: columns x, y, z (metres, world), i (intensity), t (time) and, for the sensor, d.
        frame: log frame.
        frame_time_s: seconds, of points without a time.
        where: ``log``, ``file``, … of the error, should there be one.

    Returns:
        The sweep; and findings ``invalid_points``, ``missing_intensity``, ``missing_point_time``, ``other_lidar``,
        ``no_sensor_column``, ``intensity_scale``.

    Raises:
        InputError: a column is missing, or is not numeric.
    """
    where = {**where, "frame": frame}
    require_columns(table, _COLUMNS, "the sweep", **where)
    # Columns may be integers or float32; world coordinates need float64.
    rows = np.stack([read_numbers(table, name, **where) for name in _COLUMNS], axis=1)
    selected, findings = _select_sensor(table, frame, where)
    rows = rows[selected]
    placed, unplaced = find_placed_points(rows[:, :3], frame)
    rows = rows[placed]
    # Copies, or the few columns that are used would keep the rows of the file in memory.
    points_world = np.ascontiguousarray(rows[:, :3])
    intensities, without_intensity = fill_intensities(rows[:, 3].copy(), frame, "i")
    times_s, without_time = fill_point_times(convert_to_seconds(rows[:, 4].copy()), frame_time_s, frame, "t")
    findings += unplaced + without_intensity + without_time
    scale = _find_intensity_scale(intensities)
    if scale != INTENSITY_SCALE:
        message = f"the intensities of sweep {frame} are 0 to {scale:g}, not 0 to {INTENSITY_SCALE:g}"
        numbers = {"scale": scale, "largest": float(intensities.max())}
        findings.append(Finding("intensity_scale", "note", message, "They are scaled.", numbers, frames=(frame,)))
    sweep = Sweep(
        points_world=points_world,
        intensity=np.clip(intensities / scale, 0.0, 1.0).astype(np.float32),
        timestamps_s=times_s,
    )
    return sweep, findings


def require_columns(table: Table, names: Iterable[str], what: str, **where: Any) -> None:
    """Checks that a table has the columns that are needed.

    Args:
        table: the table.
        names: needed columns.
        what: names the table in the message.
        where: ``log``, ``file``, ``frame`` of the error.

    Raises:
        InputError: columns are missing; it names those that there are, since they may only be spelled otherwise.
    """
    missing = [name for name in names if name not in table.columns]
    if not missing:
        return
    found = ", ".join(list(table.columns)[:_MAX_NAMES_LISTED]) or "none"
    respelled = {name for name in table.columns if name.lower() in missing}
    remedy = "Rename them: the layout has small letters." if respelled else "Copy the file again, or name them so."
    problem = f"{what} lacks the columns {', '.join(missing)}; it has {found}"
    raise InputError(problem, remedy=remedy, **where)


def read_numbers(table: Table, name: str, **where: Any) -> Float64:
    """Reads a column as numbers.

    Args:
        table: the table.
        name: of the column.
        where: ``log``, ``file``, ``frame`` of the error.

    Returns:
        [N] float64; NaN where a value is missing.

    Raises:
        InputError: the column is not numeric.
    """
    values = table.columns[name]
    try:
        if values.dtype == object:
            return np.array([math.nan if value is None else float(value) for value in values], dtype=np.float64)
        return values.astype(np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        problem = f"the column {name} is not numeric ({error})"
        raise InputError(problem, remedy="Write it as numbers.", **where) from error


def _select_sensor(table: Table, frame: int, where: dict[str, Any]) -> tuple[NDArray[np.bool_], list[Finding]]:
    """[N] which points are used, by the column d."""
    everything = np.ones(table.row_count, dtype=bool)
    if "d" not in table.columns:
        message = f"sweep {frame} has no column d: its points are taken to be of the spinning LiDAR"
        return everything, [Finding("no_sensor_column", "note", message, frames=(frame,))]
    sensors = read_numbers(table, "d", **where)
    spinning = sensors == SPINNING_SENSOR
    if spinning.any() or not table.row_count:
        return spinning, []
    # An empty sweep would end as "no points", hours later: these are measured points in world coordinates too.
    found = ", ".join(f"{sensor:g}" for sensor in np.unique(sensors)[:_MAX_NAMES_LISTED])
    message = f"no point of sweep {frame} is of the spinning LiDAR (d = {SPINNING_SENSOR})"
    message += f": all {table.row_count} have d = {found} (1 is the forward LiDAR), and are used"
    remedy = "Copy sweeps with the points of both sensors, or write d = 0 if they are of the spinning one."
    numbers = {"points": table.row_count, "sensor": float(sensors[0])}
    return everything, [Finding("other_lidar", "warning", message, remedy, numbers, frames=(frame,))]


def _find_intensity_scale(intensities: Float64) -> float:
    """The value that stands for full intensity in a sweep."""
    largest = float(intensities.max(initial=0.0))
    # Rounding may lead just above the scale.
    if largest > INTENSITY_SCALE + 1:
        return _WIDE_INTENSITY_SCALE
    # Zeros and ones alone may be dark points of 0 to 255; fractions below 1 are none of that scale.
    is_fraction = 0.0 < largest <= 1.0 and bool((intensities != np.round(intensities)).any())
    return 1.0 if is_fraction else INTENSITY_SCALE
