"""Reads files, JSON and times of a sequence folder, so that whatever is wrong with them is an ``InputError``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.file_kinds import describe_non_json
from genre_tasks.logs.types import Float64

_MAKE_READABLE = "Make it readable for this user, or copy it again."
_COPY_AGAIN = "Copy it again."
_JSON_REMEDY = "Copy it again, or write one JSON value, without comments and trailing commas."
_TIMES_REMEDY = "Write times as numbers (s, ms, µs or ns since 1970), or all as ISO-8601 text."
# A value may be a document of its own.
_MAX_SHOWN_CHARACTERS = 60

# 1e11 s would be the year 5138, and 1e11 ms is 1973: no log's clock is in doubt.
_UNITS_PER_SECOND = ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3))


def describe_os_error(error: OSError) -> str:
    """Says in one clause why the system refused a file.

    Args:
        error: what opening or reading it raised.

    Returns:
        The problem, without the file's name.

    >>> describe_os_error(PermissionError(13, "Permission denied"))
    'the file cannot be read (Permission denied)'
    """
    return f"the file cannot be read ({error.strerror or error})"


def read_file(path: Path, **where: Any) -> bytes:
    """Reads a file of a sequence.

    Args:
        path: the file.
        where: ``log``, ``camera``, ``frame``, … of the error, should there be one.

    Returns:
        Its bytes.

    Raises:
        InputError: the file is missing, or cannot be read.
    """
    try:
        # A pipe would wait for a writer for ever.
        if path.exists() and not path.is_file():
            raise InputError("this is no file", remedy=_MAKE_READABLE, file=path, **where)
        return path.read_bytes()
    except FileNotFoundError as error:
        remedy = "Copy the whole sequence folder again."
        raise InputError("the sequence lacks a file", remedy=remedy, file=path, **where) from error
    except OSError as error:
        raise InputError(describe_os_error(error), remedy=_MAKE_READABLE, file=path, **where) from error


def read_json(path: Path, log: str) -> Any:
    """Reads a JSON file of a sequence, in UTF-8, UTF-16 or UTF-32.

    Args:
        path: the file.
        log: URI of the log, for the error.

    Returns:
        The value.

    Raises:
        InputError: the file is missing, unreadable, malformed, or something else than JSON.
    """
    data = read_file(path, log=log)
    try:
        return json.loads(data, object_pairs_hook=build_object)
    # Brackets within brackets may overflow the interpreter's stack.
    except (ValueError, RecursionError) as error:
        kind = describe_non_json(data)
        problem = f"the file is no readable JSON ({error})" if kind is None else f"no JSON: the file is {kind}"
        remedy = _COPY_AGAIN if kind else _JSON_REMEDY
        raise InputError(problem, remedy=remedy, file=path, log=log) from error


def build_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Makes an object of JSON: of a key that stands twice, nobody knows which value is meant.

    Args:
        pairs: keys and values.

    Raises:
        ValueError: a key stands twice.

    >>> build_object([("a", 1), ("b", 2)])
    {'a': 1, 'b': 2}
    """
    value = dict(pairs)
    if len(value) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {max(keys, key=keys.count)} stands twice")
    return value


def read_entries(path: Path, log: str) -> list[object]:
    """Reads a JSON file that has one entry for every frame.

    Args:
        path: the file.
        log: URI of the log, for the error.

    Returns:
        The entries, at least one.

    Raises:
        InputError: as ``read_json``; or the value is no list, or an empty one.
    """
    entries = read_json(path, log)
    if isinstance(entries, list) and entries:
        return entries
    problem = f"a list of one entry a frame was expected, found {describe_value(entries)}"
    raise InputError(problem, remedy=_COPY_AGAIN, file=path, log=log)


def describe_value(value: object) -> str:
    """Names a JSON value for a message, shortened.

    Args:
        value: any JSON value.

    Returns:
        Its kind, and what it holds.

    >>> describe_value({"a": 1, "b": 2}), describe_value(None), describe_value("7")
    ('an object of 2 keys', 'null', "'7'")
    """
    if isinstance(value, dict):
        return f"an object of {len(value)} keys"
    if isinstance(value, list):
        return f"a list of {len(value)} entries"
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    text = repr(value)
    return text if len(text) <= _MAX_SHOWN_CHARACTERS else f"{text[:_MAX_SHOWN_CHARACTERS]}…"


def read_number(value: object) -> float:
    """Converts a JSON value to a number.

    Args:
        value: a number, or text of one.

    Returns:
        The number; it may be NaN or infinite.

    Raises:
        ValueError: it is anything else, or too large.

    >>> read_number("1.5")
    1.5
    """
    # A bool is an int of Python, and no number of a log.
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"{describe_value(value)} is no number")
    try:
        return float(value)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{describe_value(value)} is no number") from error


def read_times(path: Path, log: str) -> Float64:
    """Reads a file of timestamps.

    Args:
        path: the file: numbers in s, ms, µs or ns, text of such numbers, or ISO-8601 text. A time without a zone
            counts as UTC.
        log: URI of the log, for the error.

    Returns:
        [F] seconds, NaN where they are not finite; since 1970 where they are absolute.

    Raises:
        InputError: as ``read_entries``; an entry is no time; or times of different kinds are mixed.
    """
    entries = read_entries(path, log)
    times = np.empty(len(entries))
    kinds: list[str] = []
    for frame, entry in enumerate(entries):
        try:
            kind, times[frame] = _parse_time(entry)
        except ValueError as error:
            problem = f"entry {frame} is no time: {describe_value(entry)}"
            raise InputError(problem, remedy=_TIMES_REMEDY, file=path, log=log, frame=frame) from error
        kinds.append(kind)
        if kind != kinds[0]:
            problem = f"entry {frame} is {kind}, but entry 0 is {kinds[0]}"
            raise InputError(problem, remedy=_TIMES_REMEDY, file=path, log=log, frame=frame)
    # Infinity is no time either, and differences of two of them are invalid.
    times[~np.isfinite(times)] = np.nan
    # Text of a date says its unit; the magnitude must not be asked.
    return times if kinds[0].startswith("a date") else convert_to_seconds(times)


def _parse_time(entry: object) -> tuple[str, float]:
    """Kind of a time, and its number."""
    if not isinstance(entry, str):
        return "a number", read_number(entry)
    text = entry.strip()
    try:
        return "a number as text", float(text)
    except ValueError:
        moment = datetime.fromisoformat(text)
    if moment.tzinfo is None:
        return "a date without a time zone", moment.replace(tzinfo=UTC).timestamp()
    return "a date with a time zone", moment.timestamp()


def convert_to_seconds(timestamps: Sequence[float] | Float64) -> Float64:
    """Converts Unix times given in s, ms, µs or ns; the magnitude says which.

    Args:
        timestamps: [N] times of one file; relative times, which are small, count as seconds.

    Returns:
        [N] seconds, float64.

    >>> convert_to_seconds(np.array([1557539959250.0]))
    array([1.55753996e+09])
    """
    times = np.asarray(timestamps, dtype=np.float64)
    finite = np.abs(times[np.isfinite(times)])
    # One unit for the file: the first frames of a relative clock are small in any unit.
    largest = float(finite.max()) if finite.size else 0.0
    for limit, units_per_second in _UNITS_PER_SECOND:
        if largest > limit:
            return times / units_per_second
    return times
