"""Headers of PLY files, checked before memory is taken for what they claim."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError

from genre_tasks.errors import InputError
from genre_tasks.exchange.checks import check_claimed_size, measure_file, read_file

# Comments may be long, but no program writes more of them.
_MOST_BYTES = 1 << 18
_END = re.compile(rb"^end_header\r?\n", re.MULTILINE)
_COUNT = re.compile(rb"^([ \t]*element[ \t]+\S+[ \t]+)(\S+)[ \t]*(?=\r?$)", re.MULTILINE)
_LIST = re.compile(rb"^[ \t]*property[ \t]+list\b", re.MULTILINE)
_NOT_ASCII = re.compile(rb"[^\x00-\x7f]")
_MOST_ROWS = 1 << 62
_REMEDY = "Give a PLY file of 3D Gaussians in binary_little_endian, as 3DGS tools write it."


@dataclass(frozen=True)
class PlyTable:
    """Where an element's rows are in a file, and what a row holds.

    Attributes:
        path: of the file.
        name: of the element.
        row: numpy's type of one row.
        count: of rows.
        offset: bytes before the first row.
    """

    path: Path
    name: str
    row: np.dtype[np.void]
    count: int
    offset: int

    def read_rows(self, stream: io.BufferedReader, start: int, stop: int) -> NDArray[np.void]:
        """Reads some of the rows.

        Args:
            stream: the file, open for reading.
            start: first row.
            stop: row after the last one.

        Returns:
            ``stop - start`` rows.

        Raises:
            InputError: the file has become shorter since its header was read.
        """
        stream.seek(self.offset + start * self.row.itemsize)
        rows = np.fromfile(stream, self.row, stop - start)
        if len(rows) < stop - start:
            raise InputError("the file has become shorter while it was read", remedy=_REMEDY, file=self.path)
        return rows


@dataclass(frozen=True)
class PlyHeader:
    """A header that the file is long enough for.

    Attributes:
        tables: of the elements, by name.
        comments: of the whole header, in order.
    """

    tables: dict[str, PlyTable]
    comments: tuple[str, ...]


def read_ply_header(path: Path) -> PlyHeader:
    """Reads a header and checks that the file is as long as it claims.

    Args:
        path: of the file.

    Returns:
        The header; all elements are binary and have properties of fixed size.

    Raises:
        InputError: this is no PLY file, it is in ASCII, has lists, or is cut off.
    """
    size = measure_file(path)
    start = read_file(path, _MOST_BYTES)
    end = _END.search(start)
    if not start.startswith(b"ply") or end is None:
        raise InputError("this is no PLY file, or its header is cut off", remedy=_REMEDY, file=path)
    # Comments may be in any encoding, and nothing else of a header is beyond ASCII.
    text = _NOT_ASCII.sub(b"?", start[: end.end()])
    if _LIST.search(text):
        raise InputError("the PLY file has lists, which Gaussians do not have", remedy=_REMEDY, file=path)
    counts = [_parse_count(path, found[2]) for found in _COUNT.finditer(text)]
    # The library takes memory for what a header claims: it gets to see the header alone, with no rows.
    try:
        parsed = PlyData.read(io.BytesIO(_COUNT.sub(rb"\g<1>0", text)), mmap=False)
    except (PlyParseError, ValueError) as error:
        raise InputError(f"cannot read the PLY header: {error}", remedy=_REMEDY, file=path) from error
    if parsed.text:
        raise InputError("the PLY file is in ASCII, which is not read", remedy=_REMEDY, file=path)
    tables = {}
    offset = len(text)
    for element, count in zip(parsed.elements, counts, strict=True):
        row = np.dtype(element.dtype(parsed.byte_order))
        check_claimed_size(path, offset + count * row.itemsize, size, f"{count} rows of {element.name}")
        tables[element.name] = PlyTable(path, element.name, row, count, offset)
        offset += count * row.itemsize
    comments = (*parsed.comments, *(comment for element in parsed.elements for comment in element.comments))
    return PlyHeader(tables, comments)


def _parse_count(path: Path, word: bytes) -> int:
    # A count of many digits takes long to parse, and no file has that many rows.
    if not word.isdigit() or len(word) > len(str(_MOST_ROWS)):
        shown = word[:40].decode("ascii", "replace")
        raise InputError(f"'{shown}' is no count of rows", remedy=_REMEDY, file=path)
    return int(word)
