"""Sweeps of the layout: npz, Parquet or PLY files with x, y, z and, if known, intensity and time."""

from __future__ import annotations

import io
import math
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from genre_tasks.bounded_parquet import FOR_COLUMNS, read_bounded_table
from genre_tasks.errors import InputError
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.genre_layout.layout import POINT_COLUMNS
from genre_tasks.logs.point_values import fill_intensities, fill_point_times, find_placed_points
from genre_tasks.logs.types import Float64, Sweep

# Four turns of the largest LiDAR.
_MAX_POINTS = 4_000_000
_MAX_BYTES = _MAX_POINTS * len(POINT_COLUMNS) * 8 + (1 << 20)
_PLY_HEADER_BYTES = 1 << 16
_PLY_COUNT = re.compile(rb"^[ \t]*element[ \t]+\S+[ \t]+(\S+)", re.MULTILINE)
_HEADER_READERS: dict[tuple[int, int], Any] = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
# An archive may be damaged, encrypted, or compressed by a method that Python lacks.
_ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, RuntimeError)
_REMEDY = "Write arrays x, y, z (metres, world), intensity (0 to 1) and time_s, each [N]."


def write_sweep(path: Path, sweep: Sweep) -> None:
    """Writes a sweep as npz.

    Args:
        path: the file.
        sweep: to write; the same sweep gives the same bytes.
    """
    columns: dict[str, Any] = {name: np.ascontiguousarray(sweep.points_world[:, k]) for k, name in enumerate("xyz")}
    columns |= {"intensity": sweep.intensity, "time_s": sweep.timestamps_s}
    # numpy.savez writes the time of day into the archive.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, values in columns.items():
            entry = zipfile.ZipInfo(f"{name}.npy")
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w") as file:
                np.lib.format.write_array(file, values, allow_pickle=False)


class ReadSweep(NamedTuple):
    """A sweep of a file.

    Attributes:
        sweep: the points with a finite place; a missing intensity is 0, a missing time the frame's.
        findings: ``invalid_points``, ``missing_intensity`` and ``missing_point_time``.
        largest_intensity: of these points in the file; more than 1 is cut to 1.
    """

    sweep: Sweep
    findings: tuple[Finding, ...]
    largest_intensity: float


def read_sweep(path: Path, frame_time_s: float, log: str, frame: int) -> ReadSweep:
    """Reads a sweep.

    Args:
        path: a file of the suffix .npz, .parquet or .ply.
        frame_time_s: of points without a time.
        log: URI of the log, for errors.
        frame: log frame, for errors.

    Returns:
        The sweep, and what is odd about it.

    Raises:
        InputError: the file is missing, damaged, too large, or lacks a column.
    """
    readers = {".npz": _read_npz, ".parquet": _read_parquet, ".ply": _read_ply}
    where: dict[str, Any] = {"file": path, "log": log, "frame": frame}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"sweeps are no {path.suffix} files", remedy="Write .npz, .parquet or .ply.", **where)
    if not path.is_file():
        raise InputError("there is no such sweep", remedy="Copy it again, or name none for this frame.", **where)
    try:
        columns = reader(path)
        missing = [name for name in "xyz" if name not in columns]
        if missing:
            raise ValueError(f"it lacks {', '.join(missing)}; it has {', '.join(list(columns)[:12]) or 'nothing'}")
        arrays = {name: np.asarray(columns[name], dtype=np.float64) for name in POINT_COLUMNS if name in columns}
        lengths = {values.shape for values in arrays.values()}
        if len(lengths) != 1 or len(next(iter(lengths))) != 1:
            raise ValueError(f"its columns have the shapes {sorted(lengths)}, not one length")
    except (OSError, ValueError, TypeError, KeyError, EOFError, MemoryError, *_ZIP_ERRORS) as error:
        raise InputError(f"the sweep cannot be read ({error})", remedy=_REMEDY, **where) from error
    count = len(arrays["x"])
    arrays = {"intensity": np.zeros(count), "time_s": np.full(count, frame_time_s)} | arrays
    rows = np.stack([arrays[name] for name in POINT_COLUMNS], axis=1)
    placed, unplaced = find_placed_points(rows[:, :3], frame)
    rows = rows[placed]
    intensities, without_intensity = fill_intensities(rows[:, 3], frame)
    times_s, without_time = fill_point_times(rows[:, 4].copy(), frame_time_s, frame)
    sweep = Sweep(
        points_world=np.ascontiguousarray(rows[:, :3]),
        intensity=np.clip(intensities, 0.0, 1.0).astype(np.float32),
        timestamps_s=times_s,
    )
    findings = (*unplaced, *without_intensity, *without_time)
    return ReadSweep(sweep, findings, largest_intensity=float(intensities.max(initial=0.0)))


def _read_npz(path: Path) -> dict[str, Float64]:
    with zipfile.ZipFile(path) as archive:
        wanted = {f"{name}.npy" for name in POINT_COLUMNS}
        size = sum(entry.file_size for entry in archive.infolist() if entry.filename in wanted)
        if size > _MAX_BYTES:
            raise ValueError(f"its arrays have {size} bytes, and {_MAX_BYTES} are allowed")
        columns = {}
        for entry in archive.infolist():
            if entry.filename in wanted:
                columns[entry.filename.removesuffix(".npy")] = _parse_npy(archive.read(entry))
        return columns


def _parse_npy(data: bytes) -> Any:
    """The array of a file, unless its header claims another size than the file has."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in _HEADER_READERS:
        raise ValueError(f"an array has version {version}")
    shape, _, dtype = _HEADER_READERS[version](stream)
    # NumPy takes the memory of what a header claims before it reads the values.
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError("an array has another size than its header says")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def _read_parquet(path: Path) -> dict[str, Any]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = [name for name in pq.read_schema(path).names if name in POINT_COLUMNS]
    table = read_bounded_table(path, FOR_COLUMNS, names)
    for field in table.schema:
        if not (pa.types.is_integer(field.type) or pa.types.is_floating(field.type)):
            raise ValueError(f"its column {field.name} holds {field.type}")
    return {name: table.column(name).combine_chunks().to_numpy(zero_copy_only=False) for name in names}


def _read_ply(path: Path) -> dict[str, Any]:
    from plyfile import PlyData, PlyParseError

    with path.open("rb") as file:
        head = file.read(_PLY_HEADER_BYTES)
    if not head.startswith(b"ply") or b"end_header" not in head:
        raise ValueError("it is no PLY file")
    # The library takes memory for what a header claims.
    counts = _PLY_COUNT.findall(head)
    if any(not count.isdigit() or len(count) > 8 or int(count) > _MAX_POINTS for count in counts):
        raise ValueError(f"its header does not claim up to {_MAX_POINTS} points")
    try:
        vertices = PlyData.read(path, mmap=False)["vertex"].data
    except PlyParseError as error:
        raise ValueError(str(error)) from error
    return {name: vertices[name] for name in POINT_COLUMNS if name in vertices.dtype.names}
