"""An index of nuScenes' tables, made once: opening a scene must not parse gigabytes of JSON.

It is an SQLite file in the folder of caches. Its name holds a digest of the tables' names, sizes and times of change,
so that tables that change get another index.
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from genre_tasks.atomic_path import atomic_path
from genre_tasks.cache_folder import find_cache_folder
from genre_tasks.errors import InputError, ResourceError
from genre_tasks.logs.nuscenes.json_rows import REMEDY, stream_rows
from genre_tasks.logs.nuscenes.scene_rows import write_row_digests

# Another number makes indexes of older releases useless.
_INDEX_VERSION = 2
_CACHE_KIBIBYTES = 1 << 16
_MAX_SENSORS = 1 << 20
_RADAR = "radar"
_MAX_FLOAT = 1e300
_Rows = TypeVar("_Rows")


@dataclass(frozen=True)
class _Table:
    """A table of nuScenes: the columns that are read, which are indexed, and whose numbers may be any."""

    columns: dict[str, str]
    indexed: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()


# TEXT is text, INTEGER a whole number, and a number says how many numbers a list has.
_TABLES = {
    "scene": _Table({"token": "TEXT", "name": "TEXT"}, ("name",)),
    "sample": _Table({"token": "TEXT", "scene_token": "TEXT", "timestamp": "INTEGER"}, ("scene_token",)),
    "sensor": _Table({"token": "TEXT", "channel": "TEXT", "modality": "TEXT"}),
    "calibrated_sensor": _Table(
        {"token": "TEXT", "sensor_token": "TEXT", "translation": "3", "rotation": "4", "camera_intrinsic": "9"}
    ),
    "sample_data": _Table(
        {
            **{"token": "TEXT", "sample_token": "TEXT", "ego_pose_token": "TEXT", "calibrated_sensor_token": "TEXT"},
            **{"timestamp": "INTEGER", "filename": "TEXT", "is_key_frame": "INTEGER"},
            **{"width": "SIZE", "height": "SIZE"},
        },
        ("sample_token",),
    ),
    "ego_pose": _Table({"token": "TEXT", "translation": "3", "rotation": "4"}),
    "category": _Table({"token": "TEXT", "name": "TEXT"}),
    "instance": _Table({"token": "TEXT", "category_token": "TEXT"}),
    "sample_annotation": _Table(
        {
            **{"token": "TEXT", "sample_token": "TEXT", "instance_token": "TEXT"},
            **{"translation": "3", "size": "3", "rotation": "4"},
        },
        ("sample_token",),
        # A bad box of one scene must not take all scenes with it.
        unchecked=("translation", "size", "rotation"),
    ),
}


def open_scene_index(tables: Path, log: str, folder: Path | None = None) -> sqlite3.Connection:
    """Opens the index of a version's tables, and makes it first where there is none.

    Args:
        tables: folder of a version, such as ``v1.0-mini``.
        log: URI of the log, for errors.
        folder: where indexes are kept; ``None``: the user's folder of caches.

    Returns:
        A connection that only reads. Lists of numbers are columns with a number behind their name, from 0. Numbers of
        boxes are null where they are missing or not finite.

    Raises:
        InputError: a table is missing, malformed, or lacks a column.
        ResourceError: the index cannot be written.
    """
    path = _locate_index(tables, log, folder)
    try:
        if not path.is_file():
            _write_index(tables, path, log)
        try:
            return _connect(path)
        except sqlite3.DatabaseError:
            # A loss of power may leave half a file, which would be an error of every scene for good.
            _write_index(tables, path, log)
            return _connect(path)
    except (OSError, sqlite3.DatabaseError) as error:
        raise _describe_unwritable(error, path, log) from error


def read_scene_index(tables: Path, log: str, read: Callable[[sqlite3.Connection], _Rows]) -> _Rows:
    """Reads from the index of a version's tables; one that turns out to be damaged is made again.

    Args:
        tables: folder of a version, such as ``v1.0-mini``.
        log: URI of the log, for errors.
        read: reads from the index, and raises ``sqlite3.DatabaseError`` where it is damaged.

    Returns:
        What ``read`` returns.

    Raises:
        InputError: as :func:`open_scene_index` or ``read`` raises it.
        ResourceError: the index cannot be written, or not be read right afterwards.
    """
    with suppress(sqlite3.DatabaseError), closing(open_scene_index(tables, log)) as index:
        return read(index)
    # A damaged page in the middle shows only now, as SQLite looks at a page when its rows are wanted.
    path = _locate_index(tables, log)
    try:
        _write_index(tables, path, log)
        with closing(_connect(path)) as index:
            return read(index)
    except (OSError, sqlite3.DatabaseError) as error:
        raise _describe_unwritable(error, path, log) from error


def _locate_index(tables: Path, log: str, folder: Path | None = None) -> Path:
    # One index for all scenes: reading the tables for each scene would take as long for every one.
    return (folder or find_cache_folder()) / "nuscenes" / f"{_digest_tables(tables, log)}.sqlite"


def _describe_unwritable(error: Exception, path: Path, log: str) -> ResourceError:
    remedy = "Free space, or set GENRE_CACHE_DIR to a folder that can be written."
    return ResourceError(f"the index cannot be written ({error})", remedy=remedy, file=path, log=log)


def _write_index(tables: Path, path: Path, log: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        _build_index(tables, part, log)
        # SQLite writes without waiting for the disk: a rename could reach it before the rows do.
        with part.open("rb") as file:
            os.fsync(file.fileno())


def _connect(path: Path) -> sqlite3.Connection:
    """Opens an index to read it, and reads a row of every table: SQLite looks at a file only when it is asked."""
    index = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
    index.row_factory = sqlite3.Row
    try:
        for name in _TABLES:
            # Names are those above, and no values of files.
            index.execute(f"SELECT * FROM {name} LIMIT 1").fetchone()  # noqa: S608
    except sqlite3.DatabaseError:
        index.close()
        raise
    return index


def _digest_tables(tables: Path, log: str) -> str:
    total = hashlib.sha256(f"{_INDEX_VERSION}\n".encode())
    for name in sorted(_TABLES):
        path = tables / f"{name}.json"
        try:
            stat = path.stat()
        except OSError as error:
            raise InputError(f"the table {path.name} is missing", remedy=REMEDY, file=path, log=log) from error
        total.update(f"{path.resolve()}\0{stat.st_size}\0{stat.st_mtime_ns}\n".encode(errors="surrogateescape"))
    return total.hexdigest()[:32]


def _build_index(tables: Path, path: Path, log: str) -> None:
    with closing(sqlite3.connect(path, isolation_level=None)) as index:
        # Nobody reads the file before it is complete, so that nothing is lost if this process dies.
        for setting in ("journal_mode=OFF", "synchronous=OFF", f"cache_size=-{_CACHE_KIBIBYTES}"):
            index.execute(f"PRAGMA {setting}")
        # One transaction, as millions of them would take hours.
        index.execute("BEGIN")
        for name, table in _TABLES.items():
            file = tables / f"{name}.json"
            unused = _find_radars(index, file, log) if name == "sample_data" else frozenset()
            _fill_table(index, name, table, _parse_rows(file, table, unused, log))
            # After the rows: SQLite then sorts once, within the memory of its cache.
            try:
                index.execute(f"CREATE UNIQUE INDEX {name}_by_token ON {name} (token)")
            except sqlite3.IntegrityError as error:
                raise InputError("two rows have the same token", remedy=REMEDY, file=file, log=log) from error
            for column in table.indexed:
                index.execute(f"CREATE INDEX {name}_by_{column} ON {name} ({column})")
        write_row_digests(index)
        index.execute("COMMIT")


def _find_radars(index: sqlite3.Connection, file: Path, log: str) -> frozenset[str]:
    """Calibrated sensors whose data are not indexed: two fifths of the largest table."""
    query = (
        "SELECT calibrated_sensor.token FROM calibrated_sensor JOIN sensor ON sensor_token = sensor.token "
        "WHERE modality = ? LIMIT ?"
    )
    found = frozenset(token for (token,) in index.execute(query, (_RADAR, _MAX_SENSORS + 1)))
    if len(found) > _MAX_SENSORS:
        raise InputError(f"there are more than {_MAX_SENSORS} radars", remedy=REMEDY, file=file, log=log)
    return found


def _fill_table(index: sqlite3.Connection, name: str, table: _Table, rows: Iterator[tuple[Any, ...]]) -> None:
    columns: list[str] = []
    for column, kind in table.columns.items():
        columns += [f"{column}{k} REAL" for k in range(int(kind))] if kind.isdigit() else [f"{column} {kind}"]
    index.execute(f"CREATE TABLE {name} ({', '.join(columns)})")
    # Names are those above, and no values of files.
    query = f"INSERT INTO {name} VALUES ({', '.join('?' * len(columns))})"  # noqa: S608
    index.executemany(query, rows)


def _parse_rows(file: Path, table: _Table, unused: frozenset[str], log: str) -> Iterator[tuple[Any, ...]]:
    parsers = [
        (column, _PARSERS.get(kind) or _parse_list(int(kind), column in table.unchecked))
        for column, kind in table.columns.items()
    ]
    for number, row in enumerate(stream_rows(file, log)):
        try:
            values = [parse(row.get(column)) for column, parse in parsers]
        except ValueError as error:
            problem = f"row {number} (token {str(row.get('token'))[:40]}): {error}"
            # Which column it is takes time to find out, so that only a row that fails is asked.
            bad = next((name for name, parse in parsers if not _is_readable(parse, row.get(name))), "")
            raise InputError(f"{problem} in column {bad}", remedy=REMEDY, file=file, log=log) from error
        if row.get("calibrated_sensor_token") in unused:
            continue
        yield tuple(number for value in values for number in (value if isinstance(value, tuple) else (value,)))


def _is_readable(parse: Callable[[Any], Any], value: Any) -> bool:
    try:
        parse(value)
    except ValueError:
        return False
    return True


def _parse_text(value: Any) -> str:
    if not isinstance(value, str) or "\0" in value:
        raise ValueError("text was expected")
    # Half of a pair of surrogates is no text to SQLite.
    value.encode()
    return value


def _parse_integer(value: Any) -> int:
    if not isinstance(value, int) or not -(1 << 62) < value < 1 << 62:
        raise ValueError("a whole number was expected")
    return int(value)


def _parse_size(value: Any) -> int:
    # Sweeps have none.
    return 0 if value is None else _parse_integer(value)


def _parse_list(count: int, unchecked: bool = False) -> Callable[[Any], tuple[float | None, ...]]:
    def parse(value: Any) -> tuple[float | None, ...]:
        numbers = value
        if count == 9:
            # A matrix of a camera; sensors that are none have an empty list.
            if value == []:
                return (None,) * count
            is_matrix = isinstance(value, list) and all(isinstance(row, list) for row in value)
            numbers = [number for row in value for number in row] if is_matrix else None
        if not isinstance(numbers, list) or len(numbers) != count:
            raise ValueError(f"a list of {count} numbers was expected")
        if unchecked and all(number is None or type(number) in (int, float) for number in numbers):
            return tuple(_to_float(number) for number in numbers)
        for number in numbers:
            # Comparisons are false for what is not a number.
            if type(number) not in (int, float) or not -1e12 < number < 1e12:
                raise ValueError("a finite number was expected")
        return tuple(float(number) for number in numbers)

    return parse


def _to_float(number: float | None) -> float | None:
    # SQLite makes nulls of NaN in any case; whole numbers of JSON have no bound.
    return float(number) if number is not None and abs(number) < _MAX_FLOAT else None


_PARSERS: dict[str, Callable[[Any], Any]] = {"TEXT": _parse_text, "INTEGER": _parse_integer, "SIZE": _parse_size}
