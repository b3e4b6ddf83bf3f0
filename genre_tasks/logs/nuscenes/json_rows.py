"""Reads a JSON list of objects row by row, since a table of nuScenes may have gigabytes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from genre_tasks.errors import InputError
from genre_tasks.logs.file_kinds import describe_non_json
from genre_tasks.logs.file_reading import build_object, describe_os_error

REMEDY = "Unpack the metadata of nuScenes again."

_BLOCK_CHARACTERS = 1 << 20
# A row has some hundred characters.
_MAX_ROW_CHARACTERS = 1 << 22
_SPACE = " \t\n\r"


def stream_rows(path: Path, log: str) -> Iterator[dict[str, Any]]:
    """Reads the objects of a list, one after another.

    Args:
        path: JSON file.
        log: URI of the log, for errors.

    Yields:
        The objects; no more than a megabyte of the file is held at a time, or the longest object.

    Raises:
        InputError: the file is missing, unreadable, cut off, damaged, or no list of objects.
    """
    count = 0
    try:
        with path.open(encoding="utf-8-sig") as file:
            for row in _split_rows(_TextWindow(file)):
                yield row
                count += 1
    except FileNotFoundError as error:
        raise InputError(f"the table {path.name} is missing", remedy=REMEDY, file=path, log=log) from error
    except OSError as error:
        raise InputError(describe_os_error(error), remedy=REMEDY, file=path, log=log) from error
    # Brackets within brackets may overflow the interpreter's stack.
    except (ValueError, RecursionError) as error:
        raise InputError(_describe(path, count, error), remedy=REMEDY, file=path, log=log) from error


def _describe(path: Path, count: int, error: Exception) -> str:
    with path.open("rb") as file:
        kind = describe_non_json(file.read(1024))
    if kind is not None:
        return f"no table: the file is {kind}"
    # Places in these errors are those in a part of the file.
    if isinstance(error, json.JSONDecodeError):
        reason = error.msg
    elif isinstance(error, UnicodeDecodeError):
        reason = "bytes are no UTF-8"
    else:
        reason = str(error)
    return f"the table is no list of JSON objects (after {count} rows: {reason})"


class _TextWindow:
    """A part of a text file that moves on."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self.text = ""
        self.start = 0

    def extend(self) -> bool:
        """Reads on; false at the end of the file."""
        block = self._file.read(_BLOCK_CHARACTERS)
        self.text = self.text[self.start :] + block
        self.start = 0
        return bool(block)

    def peek(self) -> str:
        """The next character that is no space; empty at the end."""
        while True:
            while self.start < len(self.text) and self.text[self.start] in _SPACE:
                self.start += 1
            if self.start < len(self.text):
                return self.text[self.start]
            if not self.extend():
                return ""


def _split_rows(window: _TextWindow) -> Iterator[dict[str, Any]]:
    decode = json.JSONDecoder(object_pairs_hook=build_object).raw_decode
    _expect(window, "[")
    is_first = True
    while window.peek() != "]":
        if not is_first:
            _expect(window, ",")
        is_first = False
        # Numbers alone could be cut in two without notice; objects end with a bracket.
        if window.peek() != "{":
            raise ValueError(f"an object was expected, found {window.peek()!r}")
        yield _decode_row(window, decode)
    window.start += 1
    # Rows behind a bracket that damage has made would be lost without notice.
    if window.peek():
        raise ValueError(f"{window.peek()!r} stands behind the end of the list")


def _expect(window: _TextWindow, character: str) -> None:
    if window.peek() != character:
        raise ValueError(f"{character!r} was expected, found {window.peek()!r}" if window.peek() else "it is cut off")
    window.start += 1


def _decode_row(window: _TextWindow, decode: Any) -> dict[str, Any]:
    while True:
        try:
            row, window.start = decode(window.text, window.start)
        except ValueError:
            # Perhaps the rest of the row stands in the next block.
            if len(window.text) - window.start > _MAX_ROW_CHARACTERS:
                raise
            if not window.extend():
                raise
            continue
        found: dict[str, Any] = row
        return found
