"""Errors as plain values, for records, tables and programs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from genre_tasks.errors import GenreError


def record_error(error: Exception) -> dict[str, Any]:
    """Writes an error as plain values.

    Args:
        error: any error; one that is no ``GenreError`` is a fault of the program.

    Returns:
        ``class``, ``message`` and ``remedy``, then ``log``, ``chunk``, ``stage``, ``camera``, ``frame`` and ``file``
        where they are known.

    >>> from genre_tasks.errors import InputError
    >>> record_error(InputError("no such file", remedy="Check the path.", frame=3))
    {'class': 'InputError', 'message': 'no such file', 'remedy': 'Check the path.', 'frame': 3}
    """
    record: dict[str, Any] = {"class": type(error).__name__, "message": as_one_line(str(error)), "remedy": ""}
    if isinstance(error, GenreError):
        record |= {"message": as_one_line(error.problem), "remedy": as_one_line(error.remedy)}
        places = {name: getattr(error, name) for name in ("log", "chunk", "stage", "camera", "frame", "file")}
        record |= {name: place for name, place in places.items() if place is not None}
    return record


def describe_record(record: Mapping[str, Any]) -> str:
    """Writes a recorded error as a sentence, and what to do about it as another.

    Args:
        record: what :func:`record_error` gave.

    Returns:
        Message, place and remedy.

    >>> describe_record({"class": "InputError", "message": "no image", "remedy": "Copy it.", "chunk": 1, "frame": 3})
    'no image (frame 3). Copy it.'
    """
    # Not the log and the chunk: whoever prints this has named them.
    places = [f"{name} {record[name]}" for name in ("stage", "camera", "frame", "file") if name in record]
    where = f" ({', '.join(places)})" if places else ""
    return f"{record['message']}{where}. {record['remedy']}".strip()


def as_one_line(text: str) -> str:
    r"""Writes a text on one line, with no character that a terminal would obey.

    Args:
        text: any text, such as a message that quotes a file of the user's.

    Returns:
        The text; line breaks are spaces, other control characters are written as Python writes them.

    >>> as_one_line("cannot read\n  'a\x1b[2K.png'")
    "cannot read 'a\\x1b[2K.png'"
    """
    joined = re.sub(r"\s*[\r\n]+\s*", " ", text).strip()
    return re.sub(r"[\x00-\x1f\x7f-\x9f]", lambda match: repr(match[0])[1:-1], joined)
