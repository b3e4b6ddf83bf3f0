"""Parquet with declared schemas: zstd-3, byte_stream_split for floats, page checksums, strict checks on read."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from genre_tasks.bounded_parquet import FOR_COLUMNS, FOR_ROWS, MemoryBound, read_bounded_table
from genre_tasks.errors import ArtifactCorruptError, ConfigError, NonFiniteError
from storage.files import write_file

Record = TypeVar("Record")

REMEDY = "Run again: it is computed anew (or delete the artifact's folder by hand)."
_CONTRACT_REMEDY = "Fix the stage that made this value: its types are a contract."
_TABLE = b"genre.table"

POSE = pa.list_(pa.float64(), 16)
"""A 4 × 4 matrix, row by row."""


def column(name: str, kind: pa.DataType, note: str, *, nullable: bool = False) -> pa.Field:
    """Declares a column that explains itself in the file's metadata.

    Args:
        name: the column's name.
        kind: its Arrow type.
        note: what it means: unit, shape, range.
        nullable: whether it may hold nulls.

    Returns:
        The field of an Arrow schema.

    >>> column("shift_m", pa.float64(), "metres, left is positive").metadata
    {b'note': b'metres, left is positive'}
    """
    return pa.field(name, kind, nullable=nullable, metadata={"note": note})


def schema(table: str, columns: Iterable[pa.Field]) -> pa.Schema:
    """Declares a table.

    Args:
        table: its name and version, such as ``gaussians/1``; a file of another name is refused on reading.
        columns: its columns in order, made by :func:`column`.

    Returns:
        The Arrow schema with the table's name in its metadata.
    """
    return pa.schema(list(columns), metadata={_TABLE: table.encode()})


def write_table(
    path: Path,
    declared: pa.Schema,
    columns: Mapping[str, Any],
    extra: Mapping[str, str] | None = None,
    raw: Sequence[str] = (),
) -> None:
    """Writes a table; the same values give the same bytes.

    Args:
        path: the new file.
        declared: the table's schema.
        columns: name → NumPy array, list or Arrow array; exactly the declared names, no casts that lose anything.
        extra: strings for the file's metadata, such as an image size.
        raw: columns stored uncompressed and without statistics, because they are compressed already.

    Raises:
        ValueError: the columns are not those of the schema.
        ConfigError: a NumPy array has another dtype or is not one-dimensional.
    """
    # The order counts too: it decides the bytes, and with them the digest.
    if list(columns) != declared.names:
        raise ValueError(f"expected columns {declared.names}, got {list(columns)}")
    arrays = [_to_arrow(columns[f.name], f) for f in declared]
    # Sorted, so that the order in which a caller lists strings does not change the bytes.
    metadata = {**declared.metadata, **{k.encode(): v.encode() for k, v in sorted((extra or {}).items())}}
    table = pa.Table.from_arrays(arrays, schema=declared.with_metadata(metadata))
    leaves = [(_leaf_path(f), _leaf_type(f.type)) for f in declared]
    sink = io.BytesIO()
    # Splitting the bytes of floats puts like bytes together, which zstd compresses better.
    pq.write_table(
        table,
        sink,
        compression={name: "NONE" if name in raw else "ZSTD" for name, _ in leaves},
        compression_level={name: 3 for name, _ in leaves if name not in raw} or None,
        # Dictionaries pay for names that repeat; for numbers they only add a page.
        use_dictionary=[name for name, kind in leaves if pa.types.is_string(kind)],
        use_byte_stream_split=[name for name, kind in leaves if pa.types.is_floating(kind)],
        write_statistics=[name for name, _ in leaves if name not in raw],
        write_page_checksum=True,
        store_schema=True,
    )
    write_file(path, sink.getbuffer())


def write_records(
    path: Path, declared: pa.Schema, records: Iterable[Any], extra: Mapping[str, str] | None = None
) -> None:
    """Writes a table with a row for each record, whose attributes have the columns' names.

    Args:
        path: the new file.
        declared: the table's schema.
        records: objects such as dataclasses.
        extra: strings for the file's metadata.
    """
    rows = list(records)
    write_table(path, declared, {name: [getattr(row, name) for row in rows] for name in declared.names}, extra)


def read_table(path: Path, declared: pa.Schema, bound: MemoryBound = FOR_COLUMNS) -> tuple[pa.Table, dict[str, str]]:
    """Reads a table, with page checksums verified.

    Args:
        path: the file.
        declared: the schema that it must have.
        bound: what it may take in memory, see :func:`genre_tasks.bounded_parquet.read_bounded_table`.

    Returns:
        (table, extra metadata).

    Raises:
        ArtifactCorruptError: the file is missing, too large or does not decode, or a column is missing, unexpected, of
            another type or holds nulls where none are allowed; file and column are named.
    """
    if not path.is_file():
        raise ArtifactCorruptError("A table is missing", remedy=REMEDY, file=path)
    try:
        table = read_bounded_table(path, bound)
        metadata = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
    except (pa.ArrowException, OSError, ValueError) as error:
        # Arrow raises OSError without a number for damage; one with a number is the operating system's.
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise ArtifactCorruptError(f"The table does not decode ({error})", remedy=REMEDY, file=path) from error
    name = metadata.pop(_TABLE.decode(), "")
    wanted = declared.metadata[_TABLE].decode()
    # The name holds the version, so an old layout is refused before its columns are misread.
    if name != wanted:
        raise ArtifactCorruptError(f"The table is {name or 'unnamed'!r}, expected {wanted!r}", remedy=REMEDY, file=path)
    _check_columns(path, table, declared)
    return table, metadata


def read_rows(path: Path, declared: pa.Schema) -> list[dict[str, Any]]:
    """Reads a table as one dictionary a row.

    Args:
        path: the file.
        declared: the schema that it must have.

    Returns:
        Dictionaries with the columns' names and Python values.

    Raises:
        ArtifactCorruptError: as :func:`read_table`.
    """
    rows: list[dict[str, Any]] = read_table(path, declared, FOR_ROWS)[0].to_pylist()
    return rows


def read_records(path: Path, declared: pa.Schema, record: Callable[..., Record]) -> tuple[Record, ...]:
    """Reads what :func:`write_records` wrote.

    Args:
        path: the file.
        declared: the schema that it must have.
        record: the class of the records, called with a row's columns as keyword arguments.

    Returns:
        The records in order.

    Raises:
        ArtifactCorruptError: as :func:`read_table`.
    """
    return tuple(record(**row) for row in read_rows(path, declared))


def _check_columns(path: Path, table: pa.Table, declared: pa.Schema) -> None:
    for name in table.schema.names:
        if name not in declared.names:
            raise ArtifactCorruptError(f"Column {name!r} is unexpected", remedy=REMEDY, file=path)
    for field in declared:
        if field.name not in table.schema.names:
            raise ArtifactCorruptError(f"Column {field.name!r} is missing", remedy=REMEDY, file=path)
        found = table.schema.field(field.name)
        # No cast: a table with other types was written by other code, and may mean something else.
        if found.type != field.type:
            raise ArtifactCorruptError(
                f"Column {field.name!r} is {found.type}, expected {field.type}", remedy=REMEDY, file=path
            )
        if not field.nullable and table.column(field.name).null_count:
            raise ArtifactCorruptError(f"Column {field.name!r} holds nulls", remedy=REMEDY, file=path)
    # The same columns in another order would give the same value other bytes, and another digest.
    if table.schema.names != declared.names:
        raise ArtifactCorruptError("The columns are in another order", remedy=REMEDY, file=path)


def _to_arrow(values: Any, field: pa.Field) -> pa.Array:
    if isinstance(values, pa.Array):
        return values
    if isinstance(values, np.ndarray):
        expected = np.dtype(field.type.to_pandas_dtype())
        # No cast, not even a harmless one: it would hide that a stage returns another type than it promises.
        if values.dtype != expected or values.ndim != 1:
            raise ConfigError(
                f"Column {field.name!r} has {values.dtype} {values.shape}, expected {expected} [N]",
                remedy=_CONTRACT_REMEDY,
            )
        return pa.array(np.ascontiguousarray(values), type=field.type)
    # Lists hold Python values of any origin, which Arrow checks against the type.
    return pa.array(list(values), type=field.type)


def _leaf_type(kind: pa.DataType) -> pa.DataType:
    return _leaf_type(kind.value_type) if pa.types.is_nested(kind) else kind


def _leaf_path(field: pa.Field) -> str:
    # Parquet's settings of a column go by the path of its leaf, which a list nests deeper.
    path = field.name
    kind = field.type
    while pa.types.is_nested(kind):
        path = f"{path}.list.element"
        kind = kind.value_type
    return path


def column_array(table: pa.Table, name: str) -> NDArray[Any]:
    """Copies a column without nulls into NumPy.

    Args:
        table: the table.
        name: the column.

    Returns:
        A writable array [N] of the declared type.
    """
    # Copied, because Arrow's own memory is read-only and torch warns of such arrays.
    return np.array(table.column(name).combine_chunks().to_numpy(zero_copy_only=False))


def check_array(array: NDArray[Any], name: str, dtype: Any, shape: tuple[int | None, ...]) -> NDArray[Any]:
    """Checks that an array is what a codec can store without loss.

    Args:
        array: the array.
        name: what an error calls it.
        dtype: the dtype that it must have.
        shape: the shape that it must have; ``None`` stands for any size.

    Returns:
        The array.

    Raises:
        ConfigError: dtype or shape differ: a stage broke its contract.
        NonFiniteError: a float is NaN or infinite.

    >>> check_array(np.zeros((2, 3), np.float32), "positions", np.float32, (None, 3)).shape
    (2, 3)
    """
    array = np.asarray(array)
    fits = array.ndim == len(shape) and all(s is None or s == n for s, n in zip(shape, array.shape, strict=True))
    if array.dtype != np.dtype(dtype) or not fits:
        wanted = [("N" if s is None else s) for s in shape]
        raise ConfigError(
            f"{name} is {array.dtype} {list(array.shape)}, expected {np.dtype(dtype)} {wanted}",
            remedy=_CONTRACT_REMEDY,
        )
    # Stopped at the writer, where the stage is known: a reader could no longer tell who made the NaN.
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))
        raise NonFiniteError("storage", name, len(bad), tuple(int(i) for i in bad[0]))
    return array


def poses_to_column(poses: NDArray[np.float64], name: str) -> pa.Array:
    """Packs poses into a column of type :data:`POSE`.

    Args:
        poses: matrices [F, 4, 4].
        name: what an error calls them.

    Returns:
        The Arrow array [F].

    Raises:
        ConfigError: dtype or shape differ.
        NonFiniteError: a number is NaN or infinite.
    """
    # Arrow takes the flat buffer as it is, so it has to be in row order.
    flat = np.ascontiguousarray(check_array(poses, name, np.float64, (None, 4, 4))).reshape(-1)
    return pa.FixedSizeListArray.from_arrays(pa.array(flat, pa.float64()), 16)


def poses_from_rows(values: Any) -> NDArray[np.float64]:
    """Unpacks values of type :data:`POSE`.

    Args:
        values: one list of 16 numbers, or several.

    Returns:
        Matrices [F, 4, 4].

    >>> poses_from_rows([[1.0, 0, 0, 5, 0, 1, 0, 6, 0, 0, 1, 7, 0, 0, 0, 1]])[0, :3, 3]
    array([5., 6., 7.])
    """
    return np.array(values, dtype=np.float64).reshape(-1, 4, 4)
