"""SPZ 1 to 3: one gzip stream with a header of 16 bytes, read only."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from genre_tasks.errors import InputError
from genre_tasks.exchange.spz.quantization import QuantizedCloud
from genre_tasks.exchange.spz.streams import (
    EXTENSIONS_FLAG,
    HIGHEST_VERSION,
    MAGIC,
    SpzHeader,
    check_header,
    read_extensions,
    split_attributes,
)

GZIP_MAGIC = b"\x1f\x8b"
"""First bytes of a gzip stream."""

_HEADER = struct.Struct("<4sIIBBBx")
# zlib's number for gzip with the largest window.
_GZIP_WINDOW = 16 + zlib.MAX_WBITS
# Extensions describe a scene with a few numbers.
_MOST_EXTENSION_BYTES = 1 << 20
_REMEDY = "Export the file again, or give a file that is complete."


def unpack_gzip(path: Path, data: bytes) -> tuple[QuantizedCloud, tuple[str, ...]]:
    """Reads the bytes of a file.

    Args:
        path: of the file, for errors.
        data: the whole file, one gzip stream.

    Returns:
        The Gaussians, and sentences on what of the file is not read.

    Raises:
        InputError: the file is damaged, cut off, or claims more than it has, or unpacks to more than it claims.
    """
    inflater = zlib.decompressobj(_GZIP_WINDOW)
    try:
        # The header first: it says how much there is to unpack, and nothing more is unpacked.
        head = inflater.decompress(data, _HEADER.size)
        if len(head) < _HEADER.size or head[:4] != MAGIC:
            problem = "the file is gzip, and holds no SPZ"
            raise InputError(problem, remedy="Give an SPZ file, or unpack it first.", file=path)
        _, version, count, degree, bits, flags = _HEADER.unpack(head)
        header = SpzHeader(version, count, degree, bits, flags)
        if version >= HIGHEST_VERSION:
            raise InputError(f"the file is SPZ version {version} as gzip", remedy=_REMEDY, file=path)
        check_header(path, header, len(data))
        sizes = [count * width for width in header.widths()]
        room = _MOST_EXTENSION_BYTES if flags & EXTENSIONS_FLAG else 0
        # One byte more than fits, so that a stream that goes on is found out.
        body = inflater.decompress(inflater.unconsumed_tail, sum(sizes) + room + 1)
    except zlib.error as error:
        raise InputError("the file cannot be unpacked", remedy=_REMEDY, file=path) from error
    if len(body) < sum(sizes):
        problem = f"the file is cut off: {count} Gaussians need {sum(sizes)} bytes, and {len(body)} are there"
        raise InputError(problem, remedy=_REMEDY, file=path)
    if len(body) > sum(sizes) + room:
        raise InputError(f"the file unpacks to more than its {count} Gaussians", remedy=_REMEDY, file=path)
    ends = [sum(sizes[: k + 1]) for k in range(len(sizes))]
    streams = [body[end - size : end] for size, end in zip(sizes, ends, strict=True)]
    return split_attributes(header, streams), read_extensions(path, header, body[sum(sizes) :])
