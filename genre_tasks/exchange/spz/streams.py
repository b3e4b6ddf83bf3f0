"""SPZ 4: a header, a table of contents, and one Zstandard stream for each attribute."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zstandard

from genre_tasks.errors import InputError
from genre_tasks.exchange.spz.quantization import POSITION_BYTES, ROTATION_BYTES, Bytes, QuantizedCloud
from genre_tasks.exchange.types import SH_REST_COUNTS

MAGIC = b"NGSP"
"""First bytes of version 4, and of what versions 1 to 3 have compressed."""

HIGHEST_VERSION = 4
"""Version that is written, and the highest that is read."""

ANTIALIASED_FLAG = 1
"""Flag of Gaussians that were made with anti-aliasing."""

EXTENSIONS_FLAG = 2
"""Flag of files with extension records."""

SMALL_BYTES = 64 << 20
"""A file may always unpack to this much, however small it is."""

MOST_RATIO = 100
"""A larger file may unpack to this many times its size: real scenes compress by less than ten."""

_HEADER = struct.Struct("<4sIIBBBBI12x")
_ENTRY = struct.Struct("<QQ")
_RECORD = struct.Struct("<II")
_LEVEL = 19
_COORDINATE_SYSTEM = 0xADBE0003
# Right, up, back, among the names that the extension numbers.
_RUB = 4
_UNSPECIFIED = 0
_REMEDY = "Export the file again, or give a file that is complete."


class SpzHeader(NamedTuple):
    """What the header of any version says.

    Attributes:
        version: 1 to 4.
        gaussian_count: number of Gaussians.
        sh_degree: 0 to 4.
        fractional_bits: of positions.
        flags: see ``ANTIALIASED_FLAG`` and ``EXTENSIONS_FLAG``.
    """

    version: int
    gaussian_count: int
    sh_degree: int
    fractional_bits: int
    flags: int

    def widths(self) -> tuple[int, ...]:
        """Bytes of a Gaussian in each attribute, in the order of a file."""
        harmonics = 3 * SH_REST_COUNTS[self.sh_degree]
        return (POSITION_BYTES[self.version], 1, 3, 3, ROTATION_BYTES[self.version], harmonics)


def check_header(path: Path, header: SpzHeader, file_bytes: int) -> None:
    """Checks what a header says, before memory is taken for it.

    Args:
        path: of the file, for errors.
        header: of any version.
        file_bytes: size of the file.

    Raises:
        InputError: the version, the degree or the fractional bits are unknown, or so many Gaussians cannot be in a
            file of this size.
    """
    if not 1 <= header.version <= HIGHEST_VERSION:
        raise InputError(
            f"the file is SPZ version {header.version}", remedy="Versions 1 to 4 are read: convert it.", file=path
        )
    if header.sh_degree >= len(SH_REST_COUNTS):
        raise InputError(f"the file claims harmonics of degree {header.sh_degree}", remedy=_REMEDY, file=path)
    if header.fractional_bits >= 8 * POSITION_BYTES[HIGHEST_VERSION] // 3:
        problem = f"the file claims {header.fractional_bits} fractional bits of 24"
        raise InputError(problem, remedy=_REMEDY, file=path)
    raw = header.gaussian_count * sum(header.widths())
    if raw > max(SMALL_BYTES, MOST_RATIO * file_bytes):
        problem = f"the file claims {header.gaussian_count} Gaussians, far more than its {file_bytes} bytes can hold"
        raise InputError(problem, remedy=_REMEDY, file=path)


def split_attributes(header: SpzHeader, streams: Sequence[bytes]) -> QuantizedCloud:
    """Gives the attributes' bytes their shapes.

    Args:
        header: of the file.
        streams: one for each attribute, of the sizes that the header asks for.

    Returns:
        Views into ``streams``.
    """
    arrays: list[Bytes] = [
        np.frombuffer(stream, np.uint8).reshape(header.gaussian_count, width)
        for stream, width in zip(streams, header.widths(), strict=True)
    ]
    return QuantizedCloud(
        version=header.version,
        fractional_bits=header.fractional_bits,
        antialiased=bool(header.flags & ANTIALIASED_FLAG),
        positions=arrays[0],
        opacities=arrays[1],
        colors=arrays[2],
        scales=arrays[3],
        rotations=arrays[4],
        sh_rest=arrays[5],
    )


def read_extensions(path: Path, header: SpzHeader, records: bytes) -> tuple[str, ...]:
    """Looks through the extension records of a file.

    Args:
        path: of the file, for errors.
        header: of the file.
        records: the bytes of all records, which the header's flag announces.

    Returns:
        Sentences on what is not read.

    Raises:
        InputError: a record is cut off, or says that the file has other axes than SPZ's.
    """
    losses = []
    unknown = header.flags & ~(ANTIALIASED_FLAG | EXTENSIONS_FLAG)
    if unknown:
        losses.append(f"The meaning of the flags {unknown:#x} is not known.")
    if not header.flags & EXTENSIONS_FLAG:
        return tuple(losses)
    start = 0
    while start < len(records):
        if start + _RECORD.size > len(records):
            raise InputError("an extension of the file is cut off", remedy=_REMEDY, file=path)
        kind, size = _RECORD.unpack_from(records, start)
        start += _RECORD.size
        if start + size > len(records):
            raise InputError("an extension of the file is cut off", remedy=_REMEDY, file=path)
        if kind == _COORDINATE_SYSTEM:
            _check_axes(path, records[start : start + size])
        else:
            losses.append(f"The extension {kind:#010x} is not read.")
        start += size
    return tuple(losses)


def _check_axes(path: Path, payload: bytes) -> None:
    system = int.from_bytes(payload[:4], "little")
    if system not in (_UNSPECIFIED, _RUB):
        problem = f"the file has axes of its own (coordinate system {system})"
        raise InputError(problem, remedy="Write it with the axes right, up, back.", file=path)


def pack_streams(quantized: QuantizedCloud) -> bytes:
    """Builds the bytes of a file.

    Args:
        quantized: of version 4. Other tools refuse a file without Gaussians.

    Returns:
        The whole file.
    """
    # Attributes without a byte, harmonics of degree 0, have no stream.
    filled = [stream for stream in quantized.streams() if stream.size]
    compressor = zstandard.ZstdCompressor(level=_LEVEL)
    packed = [compressor.compress(np.ascontiguousarray(stream).data) for stream in filled]
    header = _HEADER.pack(
        MAGIC,
        quantized.version,
        len(quantized.positions),
        SH_REST_COUNTS.index(quantized.sh_rest.shape[1] // 3),
        quantized.fractional_bits,
        ANTIALIASED_FLAG if quantized.antialiased else 0,
        len(filled),
        _HEADER.size,
    )
    table = [_ENTRY.pack(len(part), stream.size) for part, stream in zip(packed, filled, strict=True)]
    return b"".join([header, *table, *packed])


def unpack_streams(path: Path, data: bytes) -> tuple[QuantizedCloud, tuple[str, ...]]:
    """Reads the bytes of a file.

    Args:
        path: of the file, for errors.
        data: the whole file, of version 4.

    Returns:
        The Gaussians, and sentences on what of the file is not read.

    Raises:
        InputError: the file is damaged, cut off, or claims more than it has.
    """
    if len(data) < _HEADER.size:
        raise InputError("the file is cut off in its header", remedy=_REMEDY, file=path)
    _, version, count, degree, bits, flags, stream_count, table_start = _HEADER.unpack_from(data)
    header = SpzHeader(version, count, degree, bits, flags)
    if version != HIGHEST_VERSION:
        # Lower versions are compressed as a whole, so that these first bytes would not be there.
        remedy = "Version 4 is read, and versions 1 to 3 as one gzip stream."
        raise InputError(f"the file is SPZ version {version} without compression", remedy=remedy, file=path)
    check_header(path, header, len(data))
    expected = [count * width for width in header.widths()]
    filled = [size for size in expected if size]
    start = table_start + stream_count * _ENTRY.size
    if stream_count != len(filled) or table_start < _HEADER.size or start > len(data):
        raise InputError("the file's table of contents does not fit its header", remedy=_REMEDY, file=path)
    losses = read_extensions(path, header, data[_HEADER.size : table_start])
    streams = []
    for k, raw_size in enumerate(filled):
        packed_size, claimed = _ENTRY.unpack_from(data, table_start + k * _ENTRY.size)
        if claimed != raw_size or packed_size > len(data) - start:
            raise InputError(f"stream {k} of the file has not the size it claims", remedy=_REMEDY, file=path)
        streams.append(_decompress(path, data[start : start + packed_size], raw_size))
        start += packed_size
    if start != len(data):
        raise InputError(f"{len(data) - start} bytes follow the last stream", remedy=_REMEDY, file=path)
    parts = iter(streams)
    return split_attributes(header, [next(parts) if size else b"" for size in expected]), losses


def _decompress(path: Path, packed: bytes, raw_size: int) -> bytes:
    """One stream; a frame that claims another size than the table is refused before it is unpacked."""
    try:
        claimed = zstandard.get_frame_parameters(packed).content_size
        if claimed not in (raw_size, zstandard.CONTENTSIZE_UNKNOWN):
            raise InputError(f"a stream claims {claimed} bytes instead of {raw_size}", remedy=_REMEDY, file=path)
        raw = zstandard.ZstdDecompressor().decompress(packed, max_output_size=raw_size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise InputError("a stream of the file cannot be unpacked", remedy=_REMEDY, file=path) from error
    if len(raw) != raw_size:
        raise InputError(f"a stream has {len(raw)} bytes instead of {raw_size}", remedy=_REMEDY, file=path)
    return raw
