"""A small reader of PLY point clouds: ASCII and binary little-endian; x, y, z and, if present, red, green, blue."""

from __future__ import annotations

import io
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
_REMEDY = "Give ingest.points a PLY file (ascii or binary_little_endian) with x, y, z and red, green, blue per vertex."


def read_ply(path: str | Path) -> tuple[Float64, NDArray[np.uint8] | None]:
    """Positions [P, 3] float64 and colours [P, 3] uint8 (``None`` without them) of a PLY file's vertices.

    Colours stored as floats are taken to be in [0, 1]. Raises ``InputError`` naming the file and what is wrong with it.
    """
    file = Path(path)
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read the point file: {error.strerror}", remedy=_REMEDY, file=file) from error
    form, count, columns, body = _header(data, file)
    table = _ascii(body, count, columns, file, data) if form == "ascii" else _binary(body, count, columns, file)
    missing = [c for c in "xyz" if c not in columns]
    if missing:
        raise InputError(f"the vertices have no {', '.join(missing)}", remedy=_REMEDY, file=file)
    positions = np.stack([table[c].astype(np.float64) for c in "xyz"], 1)
    bad = np.flatnonzero(~np.isfinite(positions).all(1))
    if len(bad):
        raise InputError(f"{len(bad)} vertices are not finite, the first is {bad[0]}", remedy=_REMEDY, file=file)
    if not len(positions):
        raise InputError("the file has no vertices", remedy=_REMEDY, file=file)
    if not {"red", "green", "blue"} <= set(columns):
        return positions, None
    colors = np.stack([table[c] for c in ("red", "green", "blue")], 1)
    if columns["red"] in ("<f4", "<f8"):
        colors = np.round(colors.clip(0, 1) * 255)
    return positions, colors.clip(0, 255).astype(np.uint8)


def _header(data: bytes, file: Path) -> tuple[str, int, dict[str, str], bytes]:
    """(format, vertex count, {column: numpy type}, the bytes after the header)."""
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise InputError("this is no PLY file", remedy=_REMEDY, file=file)
    body = data[data.index(b"\n", end) + 1 :] if b"\n" in data[end:] else b""
    form, count, element, columns = "", -1, "", {}
    for number, line in enumerate(data[:end].decode("ascii", "replace").splitlines(), 1):
        match line.split():
            case ["format", ("ascii" | "binary_little_endian") as form, *_]:
                pass
            case ["format", other, *_]:
                raise InputError(f"line {number}: format {other} is not supported", remedy=_REMEDY, file=file)
            case ["element", element, n]:
                if element != "vertex" and count < 0:
                    raise InputError(f"line {number}: vertices must be the first element", remedy=_REMEDY, file=file)
                if element == "vertex":
                    if not n.isdigit():
                        raise InputError(f"line {number}: {n!r} is no vertex count", remedy=_REMEDY, file=file)
                    count = int(n)
            case ["property", kind, name] if element == "vertex" and kind in _TYPES:
                columns[name] = _TYPES[kind]
            case ["property", *_] if element == "vertex":
                raise InputError(f"line {number}: cannot read {line.strip()!r}", remedy=_REMEDY, file=file)
    if not form or count < 0:
        raise InputError("the header lacks its format or its vertices", remedy=_REMEDY, file=file)
    return form, count, columns, body


def _binary(body: bytes, count: int, columns: dict[str, str], file: Path) -> NDArray:
    kind = np.dtype(list(columns.items()))
    if len(body) < count * kind.itemsize:
        whole = len(body) // max(kind.itemsize, 1)
        raise InputError(f"the file ends after {whole} of {count} vertices", remedy=_REMEDY, file=file)
    return np.frombuffer(body, kind, count)


def _ascii(body: bytes, count: int, columns: dict[str, str], file: Path, data: bytes) -> NDArray:
    lines = body.decode("ascii", "replace").splitlines()[:count]
    first = data[: len(data) - len(body)].count(b"\n") + 1
    if len(lines) < count:
        raise InputError(f"the file ends after {len(lines)} of {count} vertices", remedy=_REMEDY, file=file)
    try:
        return np.loadtxt(io.StringIO("\n".join(lines)), np.dtype(list(columns.items())), ndmin=1)
    except ValueError as error:
        for number, line in enumerate(lines, first):
            words = line.split()
            if len(words) != len(columns) or not all(_is_number(w) for w in words):
                problem = f"line {number}: {line.strip()!r} is no vertex of {len(columns)} numbers"
                raise InputError(problem, remedy=_REMEDY, file=file) from error
        raise InputError(f"cannot read the vertices: {error}", remedy=_REMEDY, file=file) from error


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
