"""A small reader of PLY point clouds: ASCII and binary little-endian; x, y, z and, if present, red, green, blue.

trimesh reads PLY too, but its errors name neither the line nor what is wrong with it, and a user's point file is the
place where that matters.
"""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "<i2",
    "ushort": "<u2",
    "int": "<i4",
    "uint": "<u4",
    "float": "<f4",
    "double": "<f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "float32": "<f4",
    "float64": "<f8",
}
_COLORS = ("red", "green", "blue")
_MAX_BYTE = 255
_MAX_SHORT = 65535
# Colours in [0, 1] that a program computed may exceed 1 a little; bytes up to 2 would be a black cloud.
_MAX_UNIT_FLOAT = 2.0
# Comments may be long, but no program writes more of them.
_MAX_HEADER_BYTES = 1 << 18
_MAX_COUNT_DIGITS = 18
_REMEDY = "Give ingest.points a PLY file (ascii or binary_little_endian) with x, y, z and red, green, blue per vertex."


def read_ply(path: str | Path) -> tuple[Float64, NDArray[np.uint8] | None]:
    """Reads the vertices of a PLY file.

    Args:
        path: of the file.

    Returns:
        Positions [P, 3] float64, and colours [P, 3] uint8, ``None`` without them. Their range in the file follows from
        the largest of them: to 255 or to 65535 for integers, to 1 or to 255 for floats.

    Raises:
        InputError: the file cannot be read, is no such PLY file, has no vertices, a vertex is not finite, or colours
            are in no such range; with the file and, where there is one, the line.
    """
    file = Path(path)
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read the point file: {error.strerror}", remedy=_REMEDY, file=file) from error
    header = _read_header(data, file)
    _check_columns(header, file)
    table = _read_ascii(data, header, file) if header.format == "ascii" else _read_binary(header, file)
    # In float64, whatever the file has: world coordinates do not fit into float32.
    positions = np.stack([table[c].astype(np.float64) for c in "xyz"], 1)
    bad = np.flatnonzero(~np.isfinite(positions).all(1))
    if len(bad):
        raise InputError(f"{len(bad)} vertices are not finite, the first is {bad[0]}", remedy=_REMEDY, file=file)
    # Missing colours are no error: the images can colour the points.
    if not set(_COLORS) <= set(header.columns):
        return positions, None
    return positions, _scale_to_bytes(np.stack([table[c] for c in _COLORS], 1), file)


def _scale_to_bytes(colors: NDArray, file: Path) -> NDArray[np.uint8]:
    """Brings colours [P, 3] of any type into [0, 255]."""
    if not np.isfinite(colors).all():
        raise InputError("colours of vertices are not finite", remedy=_REMEDY, file=file)
    is_float = colors.dtype.kind == "f"
    largest = colors.max()
    if largest > (_MAX_BYTE if is_float else _MAX_SHORT):
        remedy = "Write colours as uchar from 0 to 255, as ushort from 0 to 65535, or as float from 0 to 1."
        raise InputError(f"a colour is {largest:g}, and no known range has it", remedy=remedy, file=file)
    # Programs that come from 3DGS write floats up to 1, others floats up to 255.
    if is_float and largest <= _MAX_UNIT_FLOAT:
        # In the file's precision, and rounded, because the cast below truncates.
        colors = np.round(colors.clip(0, 1) * _MAX_BYTE)
    elif is_float:
        colors = np.round(colors)
    # PDAL writes the 16-bit colours of LAS as they are.
    elif largest > _MAX_BYTE:
        colors = np.round(colors * (_MAX_BYTE / _MAX_SHORT))
    return colors.clip(0, _MAX_BYTE).astype(np.uint8)


def check_ply_header(path: str | Path) -> int:
    """Checks what can be checked of a PLY file without reading its vertices.

    Args:
        path: of the file.

    Returns:
        How many vertices the file has.

    Raises:
        InputError: the file cannot be read, its header is none that :func:`read_ply` reads, or the file is too short
            for its vertices.
    """
    file = Path(path)
    try:
        with file.open("rb") as stream:
            start = stream.read(_MAX_HEADER_BYTES)
            size = os.fstat(stream.fileno()).st_size
    except OSError as error:
        raise InputError(f"cannot read the point file: {error.strerror}", remedy=_REMEDY, file=file) from error
    header = _read_header(start, file)
    _check_columns(header, file)
    if header.format != "ascii":
        _check_length(header, size - (len(start) - len(header.body)), file)
    return header.count


@dataclass(frozen=True)
class _Header:
    format: str  # ascii or binary_little_endian
    count: int  # vertices
    columns: dict[str, str]  # name → numpy type
    body: bytes  # what follows the header


def _read_header(data: bytes, file: Path) -> _Header:
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise InputError("this is no PLY file", remedy=_REMEDY, file=file)
    body = data[data.index(b"\n", end) + 1 :] if b"\n" in data[end:] else b""
    form = ""
    count = -1
    element = ""
    columns: dict[str, str] = {}
    for number, line in enumerate(data[:end].decode("ascii", "replace").splitlines(), 1):
        match line.split():
            case ["format", ("ascii" | "binary_little_endian") as form, *_]:
                pass
            case ["format", other, *_]:
                raise InputError(f"line {number}: format {other} is not supported", remedy=_REMEDY, file=file)
            # Elements that follow the vertices, such as faces, are never read, so they may be of any kind.
            case ["element", element, n]:
                if element != "vertex" and count < 0:
                    raise InputError(f"line {number}: vertices must be the first element", remedy=_REMEDY, file=file)
                if element == "vertex":
                    # Python refuses to read thousands of digits, by an error of its own.
                    if not n.isdigit() or len(n) > _MAX_COUNT_DIGITS:
                        raise InputError(
                            f"line {number}: {n[:_MAX_COUNT_DIGITS]!r} is no vertex count", remedy=_REMEDY, file=file
                        )
                    count = int(n)
            case ["property", kind, name] if element == "vertex" and kind in _TYPES:
                columns[name] = _TYPES[kind]
            case ["property", *_] if element == "vertex":
                raise InputError(f"line {number}: cannot read {line.strip()!r}", remedy=_REMEDY, file=file)
    if not form or count < 0:
        raise InputError("the header lacks its format or its vertices", remedy=_REMEDY, file=file)
    return _Header(form, count, columns, body)


def _check_columns(header: _Header, file: Path) -> None:
    missing = [c for c in "xyz" if c not in header.columns]
    if missing:
        raise InputError(f"the vertices have no {', '.join(missing)}", remedy=_REMEDY, file=file)
    if not header.count:
        raise InputError("the file has no vertices", remedy=_REMEDY, file=file)


def _check_length(header: _Header, available: int, file: Path) -> None:
    """Raises if fewer bytes are available than the vertices take."""
    row = np.dtype(list(header.columns.items()))
    # NumPy's own error names neither the file nor how much of it is there.
    if available < header.count * row.itemsize:
        complete = available // row.itemsize
        raise InputError(f"the file ends after {complete} of {header.count} vertices", remedy=_REMEDY, file=file)


def _read_binary(header: _Header, file: Path) -> NDArray:
    _check_length(header, len(header.body), file)
    return np.frombuffer(header.body, np.dtype(list(header.columns.items())), header.count)


def _read_ascii(data: bytes, header: _Header, file: Path) -> NDArray:
    lines = header.body.decode("ascii", "replace").splitlines()[: header.count]
    first = data[: len(data) - len(header.body)].count(b"\n") + 1
    if len(lines) < header.count:
        raise InputError(f"the file ends after {len(lines)} of {header.count} vertices", remedy=_REMEDY, file=file)
    try:
        return np.loadtxt(io.StringIO("\n".join(lines)), np.dtype(list(header.columns.items())), ndmin=1)
    except ValueError as error:
        # numpy names no line of the file: look for the first one that it cannot have read.
        for number, line in enumerate(lines, first):
            words = line.split()
            if len(words) != len(header.columns) or not all(_is_number(w) for w in words):
                problem = f"line {number}: {line.strip()!r} is no vertex of {len(header.columns)} numbers"
                raise InputError(problem, remedy=_REMEDY, file=file) from error
        raise InputError(f"cannot read the vertices: {error}", remedy=_REMEDY, file=file) from error


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
