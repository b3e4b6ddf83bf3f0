"""Parquet with declared schemas: zstd-3, byte_stream_split for floats, page checksums, strict checks on read."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from genre_tasks.errors import ArtifactCorruptError, ConfigError, NonFiniteError
from storage.files import write_file

REMEDY = "Run again: it is computed anew (or delete the artifact's folder by hand)."
_TABLE = b"genre.table"

POSE = pa.list_(pa.float64(), 16)
"""A 4 × 4 matrix, row by row."""


def column(name: str, kind: pa.DataType, note: str, *, nullable: bool = False) -> pa.Field:
    """A column with what it means (unit, shape, range) in the file's own metadata."""
    return pa.field(name, kind, nullable=nullable, metadata={"note": note})


def schema(table: str, columns: Iterable[pa.Field]) -> pa.Schema:
    """A table's schema; ``table`` is its name and version, as ``gaussians/1``."""
    return pa.schema(list(columns), metadata={_TABLE: table.encode()})


def write_table(
    path: Path,
    declared: pa.Schema,
    columns: Mapping[str, Any],
    extra: Mapping[str, str] | None = None,
    raw: Sequence[str] = (),
) -> None:
    """Write a table; the same values give the same bytes.

    Args:
        columns: name → NumPy array, list or Arrow array; exactly the declared names, no casts that lose anything.
        extra: strings for the file's metadata (image size, names).
        raw: columns stored uncompressed and without statistics, because they are compressed already.
    """
    if list(columns) != declared.names:
        raise ValueError(f"expected columns {declared.names}, got {list(columns)}")
    arrays = [_array(columns[f.name], f) for f in declared]
    metadata = {**declared.metadata, **{k.encode(): v.encode() for k, v in sorted((extra or {}).items())}}
    table = pa.Table.from_arrays(arrays, schema=declared.with_metadata(metadata))
    leaves = [(_leaf_path(f), _leaf_type(f.type)) for f in declared]
    sink = io.BytesIO()
    pq.write_table(
        table,
        sink,
        compression={name: "NONE" if name in raw else "ZSTD" for name, _ in leaves},
        compression_level={name: 3 for name, _ in leaves if name not in raw} or None,
        use_dictionary=[name for name, kind in leaves if pa.types.is_string(kind)],
        use_byte_stream_split=[name for name, kind in leaves if pa.types.is_floating(kind)],
        write_statistics=[name for name, _ in leaves if name not in raw],
        write_page_checksum=True,
        store_schema=True,
    )
    write_file(path, sink.getbuffer())


def read_table(path: Path, declared: pa.Schema) -> tuple[pa.Table, dict[str, str]]:
    """The table and its extra metadata, page checksums verified.

    Raises ``ArtifactCorruptError`` naming the file and the column that is missing, unexpected, of another type or
    holds nulls where none are allowed.
    """
    if not path.is_file():
        raise ArtifactCorruptError("A table is missing", remedy=REMEDY, file=path)
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read(use_threads=False)
    except (pa.ArrowException, OSError, ValueError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise ArtifactCorruptError(f"The table does not decode ({error})", remedy=REMEDY, file=path) from error
    metadata = dict(table.schema.metadata or {})
    name = metadata.pop(_TABLE, b"").decode()
    wanted = declared.metadata[_TABLE].decode()
    if name != wanted:
        raise ArtifactCorruptError(f"The table is {name or 'unnamed'!r}, expected {wanted!r}", remedy=REMEDY, file=path)
    _check_columns(path, table, declared)
    return table, {k.decode(): v.decode() for k, v in metadata.items()}


def _check_columns(path: Path, table: pa.Table, declared: pa.Schema) -> None:
    for have in table.schema.names:
        if have not in declared.names:
            raise ArtifactCorruptError(f"Column {have!r} is unexpected", remedy=REMEDY, file=path)
    for field in declared:
        if field.name not in table.schema.names:
            raise ArtifactCorruptError(f"Column {field.name!r} is missing", remedy=REMEDY, file=path)
        found = table.schema.field(field.name)
        if found.type != field.type:
            raise ArtifactCorruptError(
                f"Column {field.name!r} is {found.type}, expected {field.type}", remedy=REMEDY, file=path
            )
        if not field.nullable and table.column(field.name).null_count:
            raise ArtifactCorruptError(f"Column {field.name!r} holds nulls", remedy=REMEDY, file=path)
    if table.schema.names != declared.names:
        raise ArtifactCorruptError("The columns are in another order", remedy=REMEDY, file=path)


def _array(values: Any, field: pa.Field) -> pa.Array:
    if isinstance(values, pa.Array):
        return values
    if isinstance(values, np.ndarray):
        expected = np.dtype(field.type.to_pandas_dtype())
        if values.dtype != expected or values.ndim != 1:
            raise ConfigError(
                f"Column {field.name!r} has {values.dtype} {values.shape}, expected {expected} [N]",
                remedy="Fix the stage that made this value: its types are a contract.",
            )
        return pa.array(np.ascontiguousarray(values), type=field.type)
    return pa.array(list(values), type=field.type)


def _leaf_type(kind: pa.DataType) -> pa.DataType:
    return _leaf_type(kind.value_type) if pa.types.is_nested(kind) else kind


def _leaf_path(field: pa.Field) -> str:
    path, kind = field.name, field.type
    while pa.types.is_nested(kind):
        path, kind = f"{path}.list.element", kind.value_type
    return path


def array_of(table: pa.Table, name: str) -> NDArray[Any]:
    """A column without nulls as a writable NumPy array of the declared type."""
    return np.array(table.column(name).combine_chunks().to_numpy(zero_copy_only=False))


def checked(array: NDArray[Any], name: str, dtype: Any, shape: tuple[int | None, ...]) -> NDArray[Any]:
    """``array`` if it has this dtype and shape (``None``: any size) and, for floats, only finite values.

    Raises ``ConfigError`` (a stage broke its contract) or ``NonFiniteError``.
    """
    array = np.asarray(array)
    fits = array.ndim == len(shape) and all(s is None or s == n for s, n in zip(shape, array.shape, strict=True))
    if array.dtype != np.dtype(dtype) or not fits:
        want = [("N" if s is None else s) for s in shape]
        raise ConfigError(
            f"{name} is {array.dtype} {list(array.shape)}, expected {np.dtype(dtype)} {want}",
            remedy="Fix the stage that made this value: its types are a contract.",
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))
        raise NonFiniteError("storage", name, len(bad), tuple(int(i) for i in bad[0]))
    return array


def pose_rows(poses: NDArray[np.float64], name: str) -> pa.Array:
    """[F, 4, 4] float64 → a column of :data:`POSE`."""
    flat = np.ascontiguousarray(checked(poses, name, np.float64, (None, 4, 4))).reshape(-1)
    return pa.FixedSizeListArray.from_arrays(pa.array(flat, pa.float64()), 16)


def poses_of(values: Any) -> NDArray[np.float64]:
    """Rows of :data:`POSE` (Python lists) → [F, 4, 4] float64."""
    return np.array(values, dtype=np.float64).reshape(-1, 4, 4)
