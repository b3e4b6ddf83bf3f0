"""Tables of an Argoverse 2 log, which are Feather files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64

QUATERNION = ("qw", "qx", "qy", "qz")
POSITION = ("tx_m", "ty_m", "tz_m")

MAX_ROWS = 4_000_000
"""What a table may have: forty times the points of a sweep."""

# A sweep of a hundred thousand points has a megabyte.
_MAX_FILE_BYTES = 1 << 25
_MAX_MEMORY_BYTES = 1 << 28
_REMEDY = "Download the log again."
_MIN_QUATERNION_NORM = 1e-6
_MAX_DISTANCE_M = 1e9


def read_columns(
    path: Path,
    names: Sequence[str],
    log: str,
    texts: Sequence[str] = (),
    max_rows: int = MAX_ROWS,
    unchecked: Sequence[str] = (),
) -> dict[str, Any]:
    """Reads columns of a table.

    Args:
        path: Feather file.
        names: of columns that hold finite numbers.
        log: URI of the log, for errors.
        texts: of columns that hold text.
        max_rows: of the table.
        unchecked: of columns that hold numbers, some of which may be missing or not finite.

    Returns:
        Name → [N] array of the file's own type of numbers, or a list of texts. Unchecked columns are float64, with NaN
        for a number that is missing.

    Raises:
        InputError: the file is missing, too large or damaged; a column is missing or holds something else.
    """
    import pyarrow as pa

    where: dict[str, Any] = {"file": path, "log": log, "remedy": _REMEDY}
    if not path.is_file():
        raise InputError("the log lacks a table", **where)
    size = path.stat().st_size
    if size > _MAX_FILE_BYTES:
        raise InputError(f"the table has {size >> 20} MiB, and {_MAX_FILE_BYTES >> 20} are allowed", **where)
    try:
        table, columns = _read_bounded(path, {*names, *texts, *unchecked}, max_rows)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise InputError(f"the table cannot be read ({error})", **where) from error
    missing = [name for name in (*names, *texts, *unchecked) if name not in columns]
    if missing:
        raise InputError(f"the table lacks {', '.join(missing)}; it has {', '.join(columns[:12])}", **where)
    found: dict[str, Any] = {name: [str(value) for value in table.column(name).to_pylist()] for name in texts}
    for name in (*names, *unchecked):
        column = table.column(name).combine_chunks()
        is_number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
        if not is_number or (column.null_count and name not in unchecked):
            raise InputError(f"the column {name} holds {column.type}, or nulls", **where)
        values = column.to_numpy(zero_copy_only=False)
        if name in unchecked:
            values = values.astype(np.float64)
        elif not np.isfinite(values.astype(np.float64)).all():
            raise InputError(f"the column {name} is not finite", **where)
        found[name] = values
    return found


def _read_bounded(path: Path, wanted: set[str], max_rows: int) -> tuple[Any, list[str]]:
    """The table, with no more than the wanted columns, and the names of all."""
    import pyarrow as pa

    with pa.OSFile(str(path)) as source:
        # Version 1 of Feather is no file of Arrow; the dataset has none.
        schema = pa.ipc.open_file(source).schema
        fields = [index for index, name in enumerate(schema.names) if name in wanted]
        options = pa.ipc.IpcReadOptions(included_fields=fields, use_threads=False)
        reader = pa.ipc.open_file(source, options=options)
        batches: list[pa.RecordBatch] = []
        # Batch by batch, as a few compressed bytes may become gigabytes.
        for index in range(reader.num_record_batches):
            batches.append(reader.get_batch(index))
            if sum(batch.nbytes for batch in batches) > _MAX_MEMORY_BYTES:
                raise ValueError(f"it takes more than {_MAX_MEMORY_BYTES >> 20} MiB of memory")
            if sum(batch.num_rows for batch in batches) > max_rows:
                raise ValueError(f"it has more than {max_rows} rows")
        table = pa.Table.from_batches(batches, reader.schema)
    table.validate(full=True)
    return table, schema.names


def compose_poses(columns: dict[str, Any], path: Path, log: str) -> tuple[Rotation, Float64]:
    """Makes rotations and positions of a table's rows.

    Args:
        columns: with those of :data:`QUATERNION` and :data:`POSITION`.
        path: the file, for errors.
        log: URI of the log, for errors.

    Returns:
        [N] rotations and [N, 3] positions.

    Raises:
        InputError: a quaternion is zero.
    """
    quats = np.stack([columns[name] for name in QUATERNION], axis=1).astype(np.float64)
    if len(quats) and np.linalg.norm(quats, axis=1).min() < _MIN_QUATERNION_NORM:
        raise InputError("a quaternion is zero", remedy=_REMEDY, file=path, log=log)
    positions = np.stack([columns[name] for name in POSITION], axis=1).astype(np.float64)
    if np.abs(positions).max(initial=0.0) > _MAX_DISTANCE_M or np.abs(quats).max(initial=0.0) > _MAX_DISTANCE_M:
        raise InputError("a pose leads out of the world", remedy=_REMEDY, file=path, log=log)
    # SciPy puts the scalar part last.
    rotations = Rotation.from_quat(quats[:, [1, 2, 3, 0]].reshape(-1, 4))
    return rotations, positions
