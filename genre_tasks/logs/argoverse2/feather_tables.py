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

# A sweep of a hundred thousand points has a megabyte. Compressed, a file holds 255 times its size at most.
_MAX_FILE_BYTES = 1 << 25
_REMEDY = "Download the log again."
_MIN_QUATERNION_NORM = 1e-6


def read_columns(path: Path, names: Sequence[str], log: str, texts: Sequence[str] = ()) -> dict[str, Any]:
    """Reads columns of a table.

    Args:
        path: Feather file.
        names: of columns that hold finite numbers.
        log: URI of the log, for errors.
        texts: of columns that hold text.

    Returns:
        Name → [N] array of the file's own type of numbers, or a list of texts.

    Raises:
        InputError: the file is missing, too large or damaged; a column is missing or holds something else.
    """
    import pyarrow as pa
    from pyarrow import feather

    where: dict[str, Any] = {"file": path, "log": log, "remedy": _REMEDY}
    if not path.is_file():
        raise InputError("the log lacks a table", **where)
    size = path.stat().st_size
    if size > _MAX_FILE_BYTES:
        raise InputError(f"the table has {size >> 20} MiB, and {_MAX_FILE_BYTES >> 20} are allowed", **where)
    try:
        table = feather.read_table(path, memory_map=False, use_threads=False)
        table.validate(full=True)
        columns = table.column_names
    except (OSError, ValueError, pa.ArrowException) as error:
        raise InputError(f"the table cannot be read ({error})", **where) from error
    missing = [name for name in (*names, *texts) if name not in columns]
    if missing:
        raise InputError(f"the table lacks {', '.join(missing)}; it has {', '.join(columns[:12])}", **where)
    found: dict[str, Any] = {name: [str(value) for value in table.column(name).to_pylist()] for name in texts}
    for name in names:
        column = table.column(name).combine_chunks()
        is_number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
        if not is_number or column.null_count:
            raise InputError(f"the column {name} holds {column.type}, or nulls", **where)
        values = column.to_numpy(zero_copy_only=False)
        if not np.isfinite(values.astype(np.float64)).all():
            raise InputError(f"the column {name} is not finite", **where)
        found[name] = values
    return found


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
    # SciPy puts the scalar part last.
    rotations = Rotation.from_quat(quats[:, [1, 2, 3, 0]].reshape(-1, 4))
    return rotations, np.stack([columns[name] for name in POSITION], axis=1).astype(np.float64)
