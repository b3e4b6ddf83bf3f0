"""Unpacks files as pandas compresses them, recognised by their first bytes, and never beyond a limit."""

from __future__ import annotations

import bz2
import gzip
import lzma
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import BinaryIO

# What the unpackers raise on files that are cut off, damaged or encrypted.
UNPACKING_ERRORS = (OSError, EOFError, zlib.error, lzma.LZMAError, zipfile.BadZipFile, RuntimeError, ValueError)

# An xz file names the memory that it needs; the strongest preset of xz needs 65 MiB.
_MAX_XZ_MEMORY_BYTES = 128 * 2**20


def unpack(path: Path, max_bytes: int) -> bytes:
    """Reads a file, unpacked if it is compressed with gzip, bzip2, xz or ZIP.

    Args:
        path: the file; its name does not matter.
        max_bytes: of the unpacked content.

    Returns:
        The content.

    Raises:
        OSError, EOFError, …: ``UNPACKING_ERRORS``; the file cannot be read, is damaged, or is larger than allowed.
    """
    with path.open("rb") as raw:
        start = raw.read(max(map(len, _UNPACKERS)))
        raw.seek(0)
        unpackers = [unpacker for signature, unpacker in _UNPACKERS.items() if start.startswith(signature)]
        read = unpackers[0] if unpackers else _read_plain
        # One byte above the limit shows that a file is too large without unpacking all of it.
        data = read(raw, max_bytes + 1)
    if len(data) > max_bytes:
        raise EOFError(f"more than {max_bytes >> 20} MiB unpacked")
    return data


def _read_plain(raw: BinaryIO, count: int) -> bytes:
    return raw.read(count)


def _read_gzip(raw: BinaryIO, count: int) -> bytes:
    return gzip.GzipFile(fileobj=raw).read(count)


def _read_bzip2(raw: BinaryIO, count: int) -> bytes:
    return bz2.BZ2File(raw).read(count)


def _read_xz(raw: BinaryIO, count: int) -> bytes:
    decompressor = lzma.LZMADecompressor(memlimit=_MAX_XZ_MEMORY_BYTES)
    data = decompressor.decompress(raw.read(), max_length=count)
    if not decompressor.eof and len(data) < count:
        raise EOFError("the xz file ends too early")
    return data


def _read_zip(raw: BinaryIO, count: int) -> bytes:
    with zipfile.ZipFile(raw) as archive:
        names = archive.namelist()
        if len(names) != 1:
            raise EOFError(f"a ZIP archive of {len(names)} files, where one was expected")
        with archive.open(names[0]) as member:
            return member.read(count)


_UNPACKERS: Mapping[bytes, Callable[[BinaryIO, int], bytes]] = {
    b"\x1f\x8b": _read_gzip,
    b"BZh": _read_bzip2,
    b"\xfd7zXZ\0": _read_xz,
    b"PK\x03\x04": _read_zip,
}
