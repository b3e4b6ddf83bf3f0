"""Checks the footer of a Parquet file for what ends the process where Arrow's Python bindings meet it.

``RowGroupMetaData.column`` of PyArrow lets no exception of C++ through: statistics of sizes that do not fit the schema
call ``std::terminate``. The footer is read here first, in Thrift's compact protocol, as the format states it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pyarrow.parquet as pq

_MAX_FOOTER_BYTES = 1 << 23
_MAX_DEPTH = 16
_TAIL_BYTES = 8

# Fields of the format's structures: FileMetaData, RowGroup, ColumnChunk, ColumnMetaData, SizeStatistics.
_ROW_GROUPS = 4
_COLUMNS = 1
_META_DATA = 3
_CRYPTO = 8
_SIZES = 16
_TEXT_BYTES = 1
_REPETITIONS = 2
_DEFINITIONS = 3

# Types of the compact protocol.
_TRUE = 1
_FALSE = 2
_BYTE = 3
_DOUBLE = 7
_BINARY = 8
_LIST = 9
_SET = 10
_STRUCT = 12
_INTEGERS = (4, 5, 6)


def check_footer(path: Path, metadata: pq.FileMetaData) -> None:
    """Raises for a footer whose columns must not be asked for.

    Args:
        path: the Parquet file.
        metadata: of the file, as Arrow reads it; its columns are not touched.

    Raises:
        ValueError: the footer is damaged, encrypted, too large, or has statistics of other columns.
    """
    schema = metadata.schema
    levels = [
        (column.max_repetition_level, column.max_definition_level, column.physical_type)
        for column in (schema.column(index) for index in range(len(schema)))
    ]
    footer = _CompactReader(_read_footer(path)).read_struct(0)
    for group in _get(footer, _ROW_GROUPS, list):
        for index, chunk in enumerate(_get(group, _COLUMNS, list)):
            meta_data = _get(chunk, _META_DATA, dict)
            if index >= len(levels) or _CRYPTO in chunk or not meta_data:
                raise ValueError(f"the footer's column {index} is none of the schema, or is encrypted")
            _check_sizes(_get(meta_data, _SIZES, dict), *levels[index])


def _get(fields: Any, number: int, kind: type) -> Any:
    """A field of a structure; empty where it is missing."""
    value = fields.get(number, kind()) if isinstance(fields, dict) else None
    if not isinstance(value, kind):
        raise ValueError(f"the footer's field {number} is no {kind.__name__}")
    return value


def _check_sizes(sizes: dict[int, Any], repetition_level: int, definition_level: int, physical_type: str) -> None:
    for field, level in ((_REPETITIONS, repetition_level), (_DEFINITIONS, definition_level)):
        # A histogram may be missing.
        if len(_get(sizes, field, list)) not in (0, level + 1):
            raise ValueError("the footer's statistics of sizes do not fit the schema")
    if _TEXT_BYTES in sizes and physical_type != "BYTE_ARRAY":
        raise ValueError("the footer states the size of texts for a column of numbers")


def _read_footer(path: Path) -> bytes:
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(size - _TAIL_BYTES, 0))
        tail = file.read()
        length = int.from_bytes(tail[:4], "little")
        if tail[4:] != b"PAR1" or length > min(size - _TAIL_BYTES, _MAX_FOOTER_BYTES):
            raise ValueError(f"the footer is damaged, encrypted, or has {length} bytes")
        file.seek(size - _TAIL_BYTES - length)
        return file.read(length)


class _CompactReader:
    """Reads values of Thrift's compact protocol; texts are skipped."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def read_struct(self, depth: int) -> dict[int, Any]:
        """A structure as its fields by their numbers."""
        if depth > _MAX_DEPTH:
            raise ValueError("the footer is nested too deep")
        fields: dict[int, Any] = {}
        number = 0
        while True:
            head = self._take(1)[0]
            kind = head & 15
            if kind == 0:
                return fields
            number = number + (head >> 4) if head >> 4 else self._read_integer()
            # In a structure the type of a truth is its value.
            fields[number] = kind == _TRUE if kind in (_TRUE, _FALSE) else self._read_value(kind, depth)

    def _read_value(self, kind: int, depth: int) -> Any:
        if kind in _INTEGERS:
            return self._read_integer()
        if kind == _STRUCT:
            return self.read_struct(depth + 1)
        if kind in (_LIST, _SET):
            return self._read_list(depth)
        lengths = {_TRUE: 1, _FALSE: 1, _BYTE: 1, _DOUBLE: 8}
        if kind not in lengths and kind != _BINARY:
            # Maps and unknown types are no part of a footer.
            raise ValueError(f"the footer has a value of type {kind}")
        self._take(self._read_varint() if kind == _BINARY else lengths[kind])
        return None

    def _read_list(self, depth: int) -> list[Any]:
        head = self._take(1)[0]
        count = head >> 4
        if count == 15:
            count = self._read_varint()
        # Every value takes a byte at least.
        if count > len(self._data) - self._at:
            raise ValueError("the footer is cut off")
        return [self._read_value(head & 15, depth + 1) for _ in range(count)]

    def _read_integer(self) -> int:
        value = self._read_varint()
        return (value >> 1) ^ -(value & 1)

    def _read_varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self._take(1)[0]
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise ValueError("the footer has a number of more than ten bytes")

    def _take(self, count: int) -> bytes:
        data = self._data[self._at : self._at + count]
        if len(data) < count:
            raise ValueError("the footer is cut off")
        self._at += count
        return data
