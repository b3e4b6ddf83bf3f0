"""GLB: a header, the JSON and one binary part in a single file."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

from genre_tasks.errors import InputError
from genre_tasks.exchange.gltf.document import MOST_JSON_BYTES

_MAGIC = b"glTF"
_VERSION = 2
_HEADER = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")
_JSON = b"JSON"
_BINARY = b"BIN\0"
_ALIGNMENT = 4
_MOST_BYTES = (1 << 32) - 1
_REMEDY = "Export the file again, or give a file that is complete."


def split_container(path: Path, data: bytes) -> tuple[bytes, memoryview]:
    """Takes a file apart.

    Args:
        path: of the file, for errors.
        data: the whole file.

    Returns:
        The JSON's bytes, and a view of the binary part; the latter is empty where the file has none.

    Raises:
        InputError: the file is no GLB file, or its lengths do not fit, or its JSON is too long.
    """
    if len(data) < _HEADER.size or data[: len(_MAGIC)] != _MAGIC:
        raise InputError("the file is no GLB file", remedy="It starts with glTF; .gltf is not read.", file=path)
    _, version, length = _HEADER.unpack_from(data)
    if version != _VERSION:
        raise InputError(f"the file is GLB version {version}", remedy="Convert it to version 2.", file=path)
    if length != len(data):
        problem = f"the file claims {length} bytes, and {len(data)} are there"
        raise InputError(problem, remedy=_REMEDY, file=path)
    chunks = _list_chunks(path, data)
    if not chunks or chunks[0][0] != _JSON:
        raise InputError("the file's first part is not JSON", remedy=_REMEDY, file=path)
    text = chunks[0][1]
    if len(text) > MOST_JSON_BYTES:
        problem = f"the file's JSON has {len(text)} bytes, and at most {MOST_JSON_BYTES} are read"
        raise InputError(problem, remedy="Export it with fewer nodes.", file=path)
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == _BINARY else memoryview(b"")
    return bytes(text), binary


def _list_chunks(path: Path, data: bytes) -> list[tuple[bytes, memoryview]]:
    """The first two parts of a file, by kind; readers shall ignore further ones."""
    chunks: list[tuple[bytes, memoryview]] = []
    start = _HEADER.size
    while start < len(data) and len(chunks) < 2:
        if start + _CHUNK.size > len(data):
            raise InputError("the file is cut off", remedy=_REMEDY, file=path)
        size, kind = _CHUNK.unpack_from(data, start)
        start += _CHUNK.size
        if start + size > len(data):
            problem = f"a part of the file claims {size} bytes, and {len(data) - start} are there"
            raise InputError(problem, remedy=_REMEDY, file=path)
        chunks.append((kind, memoryview(data)[start : start + size]))
        start += size
    return chunks


def align(size: int) -> int:
    """Rounds a number of bytes up to where the next array may start.

    >>> align(5)
    8
    """
    return -(-size // _ALIGNMENT) * _ALIGNMENT


def write_container(path: Path, text: bytes, arrays: Iterable[memoryview], binary_bytes: int) -> None:
    """Writes a file.

    Args:
        path: of the file.
        text: the JSON.
        arrays: bytes of the binary part, one after the other; each is filled up to a multiple of four.
        binary_bytes: their sum, filled up.

    Raises:
        InputError: the file would be larger than GLB can be.
    """
    json_bytes = align(len(text))
    total = _HEADER.size + _CHUNK.size + json_bytes
    if binary_bytes:
        total += _CHUNK.size + binary_bytes
    if total > _MOST_BYTES:
        problem = f"the scene needs {total} bytes, and a GLB file has less than 4 GiB"
        raise InputError(problem, remedy="Write several chunks, or choose ply or spz.", file=path)
    with path.open("wb") as stream:
        stream.write(_HEADER.pack(_MAGIC, _VERSION, total))
        stream.write(_CHUNK.pack(json_bytes, _JSON))
        # JSON is filled up with blanks, so that it stays JSON.
        stream.write(text.ljust(json_bytes))
        if not binary_bytes:
            return
        stream.write(_CHUNK.pack(binary_bytes, _BINARY))
        for array in arrays:
            stream.write(array)
            stream.write(bytes(align(array.nbytes) - array.nbytes))
