"""Reads Parquet tables within a bound of memory: a few bytes of a file can repeat a row a billion times."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from genre_tasks.parquet_footer import check_footer


@dataclass(frozen=True)
class MemoryBound:
    """What a table may take in memory.

    Attributes:
        most_bytes: of the table, whatever its file's size.
        file_ratio: so many times its file's size a table may take in any case.
        value_bytes: what a value takes at least.
        row_bytes: what a row takes besides its values.
    """

    most_bytes: int
    file_ratio: int
    value_bytes: int
    row_bytes: int


FOR_COLUMNS = MemoryBound(256 << 20, file_ratio=64, value_bytes=1, row_bytes=0)
"""For tables that are read as arrays. Harmonics of a million Gaussians may all be zero, which takes no file."""

FOR_ROWS = MemoryBound(64 << 20, file_ratio=4, value_bytes=8, row_bytes=200)
"""For tables whose rows become dictionaries of Python."""

_WIDTHS = {"INT32": 4, "INT64": 8, "INT96": 12, "FLOAT": 4, "DOUBLE": 8, "BOOLEAN": 1}
# An offset in Arrow, or a reference in Python.
_TEXT_BYTES = 8
_DICTIONARIES = {"RLE_DICTIONARY", "PLAIN_DICTIONARY"}


class TableTooLargeError(ValueError):
    """A table would take more memory than its reader allows."""


def read_bounded_table(path: Path, bound: MemoryBound, columns: Sequence[str] | None = None) -> pa.Table:
    """Reads a table with page checksums verified, unless it would take too much memory.

    Args:
        path: the file.
        bound: what the table may take in memory.
        columns: names of those to read; ``None``: all.

    Returns:
        The table, as Arrow itself reads it.

    Raises:
        TableTooLargeError: the table would take more.
        pyarrow.ArrowException: the file is no Parquet table, or is damaged; also ``OSError`` and ``ValueError``.
    """
    most_bytes = max(bound.most_bytes, bound.file_ratio * path.stat().st_size)
    with pq.ParquetFile(path, page_checksum_verification=True) as file:
        expected = file.schema_arrow
        check_footer(path, file.metadata)
        if len(set(expected.names)) < len(expected.names):
            # Asked for by its name, none of them is found.
            raise ValueError("two columns have the same name")
        size, repeated = _measure_metadata(file.metadata, bound, columns)
        _require_within(size, most_bytes)
        if not repeated:
            # One thread: tables are small, and threads of Arrow would run beside those of a stage.
            return _validate(file.read(columns=columns, use_threads=False))
    # Repeated texts stay references to one text until their length is known.
    with pq.ParquetFile(path, page_checksum_verification=True, read_dictionary=repeated) as file:
        table = file.read(columns=columns, use_threads=False)
    _require_within(table.nbytes + sum(_measure_texts(table.column(name)) for name in repeated), most_bytes)
    unknown = set(table.column_names) - set(expected.names)
    if unknown:
        # Arrow takes names from the schema, or from beside the bytes.
        raise ValueError(f"the schema has no columns {', '.join(map(repr, sorted(unknown)))}")
    fields = [expected.field(name) for name in table.column_names]
    return _validate(table.cast(pa.schema(fields, expected.metadata)))


def _validate(table: pa.Table) -> pa.Table:
    """The table, whose texts and names are UTF-8."""
    # Arrow believes a file that says so, and would raise when a text becomes one of Python.
    table.validate(full=True)
    _ = table.column_names
    return table


def _measure_metadata(
    metadata: pq.FileMetaData, bound: MemoryBound, columns: Sequence[str] | None
) -> tuple[int, list[str]]:
    """Bytes by what the file says of itself, and the columns whose texts are stored once and referred to."""
    size = metadata.num_rows * bound.row_bytes
    repeated = set()
    for group in range(metadata.num_row_groups):
        row_group = metadata.row_group(group)
        for index in range(row_group.num_columns):
            chunk = row_group.column(index)
            described = metadata.schema.column(index)
            # Of the schema, by which Arrow reads; the name beside the column's bytes may be another one.
            name = described.path
            if columns is not None and not _is_among(name, columns):
                continue
            # The name of a column that is no part of another may have dots of its own.
            is_flat = described.max_repetition_level == 0 and described.name == name
            width = _WIDTHS.get(chunk.physical_type) or described.length
            has_dictionary = bool(_DICTIONARIES & set(chunk.encodings))
            if width:
                size += chunk.num_values * max(width, bound.value_bytes)
            elif is_flat or not has_dictionary:
                size += chunk.num_values * _TEXT_BYTES + chunk.total_uncompressed_size
                repeated |= {name} if has_dictionary else set()
            else:
                # Of a list of texts it is not known how long they are: every one may be the longest.
                size += chunk.num_values * max(chunk.total_uncompressed_size, _TEXT_BYTES)
    return size, sorted(repeated)


def _is_among(path: str, columns: Sequence[str]) -> bool:
    """Whether a column of the file belongs to one of the named ones, which may have parts."""
    return any(path == column or path.startswith(f"{column}.") for column in columns)


def _require_within(size: int, most_bytes: int) -> None:
    if size > most_bytes:
        raise TableTooLargeError(f"it would take {size >> 20} MiB of memory, and {most_bytes >> 20} are allowed")


def _measure_texts(column: pa.ChunkedArray) -> int:
    """Bytes of a column's texts when every row has its text."""
    size = 0
    for chunk in column.chunks:
        if not isinstance(chunk, pa.DictionaryArray):
            continue
        lengths = pc.cast(pc.binary_length(chunk.dictionary), pa.int64())
        size += pc.sum(lengths.take(chunk.indices)).as_py() or 0
    return size


class RowReader:
    """Reads large values row by row, such as images; rows before the wanted one are decoded and dropped.

    Going forward costs nothing more. Going back starts again at the beginning of a group of rows.

    Args:
        path: the file.
        bound: what the columns of one group may take when decoded; no more than a row of them is held.
        columns: names of those to read.
    """

    def __init__(self, path: Path, bound: MemoryBound, columns: Sequence[str]) -> None:
        self._path = path
        self._columns = list(columns)
        most_bytes = max(bound.most_bytes, bound.file_ratio * path.stat().st_size)
        with pq.ParquetFile(path) as file:
            metadata = file.metadata
            check_footer(path, metadata)
            self._first_rows = [0]
            for group in range(metadata.num_row_groups):
                _require_within(_measure_group(metadata, group, self._columns), most_bytes)
                self._first_rows.append(self._first_rows[-1] + metadata.row_group(group).num_rows)
        self._rows: Iterator[pa.RecordBatch] = iter(())
        self._group = -1
        self._next = 0
        # Stages read images in several threads.
        self._lock = Lock()

    def read(self, row: int) -> pa.RecordBatch:
        """Reads one row.

        Args:
            row: from 0, below the number of rows of the table.

        Returns:
            A batch of one row.

        Raises:
            pyarrow.ArrowException: the file is damaged; also ``OSError`` and ``ValueError``.
        """
        with self._lock:
            group = bisect_right(self._first_rows, row) - 1
            if group >= len(self._first_rows) - 1:
                raise ValueError(f"the table has no row {row}")
            if group != self._group or row < self._next:
                self._start(group)
            try:
                while True:
                    batch = next(self._rows)
                    self._next += 1
                    if self._next > row:
                        return batch
            except BaseException as error:
                # What broke off is not gone on with.
                self._group = -1
                if isinstance(error, StopIteration):
                    raise ValueError(f"the table ends before row {row}") from error
                raise

    def _start(self, group: int) -> None:
        # Without buffers of the file's own: a group may have hundreds of megabytes.
        file = pq.ParquetFile(self._path, page_checksum_verification=True, pre_buffer=False, buffer_size=1 << 20)
        self._rows = file.iter_batches(batch_size=1, row_groups=[group], columns=self._columns, use_threads=False)
        self._group = group
        self._next = self._first_rows[group]


def _measure_group(metadata: pq.FileMetaData, group: int, columns: Sequence[str]) -> int:
    """Bytes of the columns of a group by what the file says of itself."""
    row_group = metadata.row_group(group)
    size = 0
    for index in range(row_group.num_columns):
        if _is_among(metadata.schema.column(index).path, columns):
            chunk = row_group.column(index)
            size += max(chunk.num_values * _WIDTHS.get(chunk.physical_type, _TEXT_BYTES), chunk.total_uncompressed_size)
    return size
