"""The standard streams of a command: a character, a reader that left or a closed stream is never its end."""

from __future__ import annotations

import codecs
import contextlib
import errno
import io
import os
import select
import sys
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from flows.cli.signals import delay_signals

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

FALLBACK_WIDTH = 110
"""Columns where nobody says how wide the output is: the 80 that are usual would fold most tables."""
_MIN_WIDTH = 20


def prepare_streams() -> None:
    """Makes the standard streams fit for any text, any reader and any end of the reader.

    * A character that the stream's encoding lacks is replaced, by ``?``.
    * A reader that closes its pipe, such as ``head``, does not end the command: the rest of the output is dropped.
    * A stream that the caller closed (``>&-``) takes everything and keeps nothing; no other file gets its number.
    * Any other failure to write to stdout is a ``ResourceError``. On stderr it is ignored: nobody could read it.
    """
    for descriptor in (0, 1, 2):
        _open_if_closed(descriptor)
    if sys.stdin is None:
        sys.stdin = Path(os.devnull).open(encoding="utf-8")  # noqa: SIM115
    sys.stdout = _prepare_output(sys.stdout, is_result=True)
    sys.stderr = _prepare_output(sys.stderr, is_result=False)


def terminal_width(stream: TextIO) -> int:
    """Finds how many columns the lines of a stream may have.

    Args:
        stream: such as ``sys.stdout``.

    Returns:
        The narrower of the terminal and the variable ``COLUMNS``; ``FALLBACK_WIDTH`` without either. Never less than
        20: a narrower terminal folds lines by itself.
    """
    stated = os.environ.get("COLUMNS", "")
    widths = [int(stated)] if stated.isascii() and stated.isdigit() else []
    # A pipe, a file, or an object without a descriptor, as tests put in place of a stream, has no size.
    with contextlib.suppress(OSError, ValueError, AttributeError):
        widths.append(os.get_terminal_size(stream.fileno()).columns)
    # A terminal may say that it has 0 columns, which means that it does not know.
    return max(_MIN_WIDTH, min((width for width in widths if width > 0), default=FALLBACK_WIDTH))


def is_rewritable(stream: TextIO) -> bool:
    """Finds out whether a line that is written to a stream can be rewritten.

    Args:
        stream: such as ``sys.stderr``.

    Returns:
        Whether it is a terminal that obeys escape sequences.
    """
    return stream.isatty() and os.environ.get("TERM", "") not in ("dumb", "unknown")


class _ForgivingFile(io.FileIO):
    """A descriptor that takes everything after the first failed write, and keeps nothing of it.

    Args:
        descriptor: 1 or 2.
        is_result: whether the failure must be reported: what goes to stdout is what the user asked for.
    """

    def __init__(self, descriptor: int, is_result: bool) -> None:
        super().__init__(descriptor, "wb", closefd=False)
        self._is_result = is_result

    # Broken off after the last byte, it would leave the text in the buffer above, and the text would be written twice.
    @delay_signals
    def write(self, data: ReadableBuffer, /) -> int:
        remaining = memoryview(data).cast("B")
        count = len(remaining)
        try:
            while len(remaining):
                written = super().write(remaining)
                if written is None:
                    # Another process has made the pipe non-blocking, and it is full.
                    select.select([], [self.fileno()], [])
                else:
                    remaining = remaining[written:]
        except OSError as error:
            # Text that waits in the buffers above would fail again at the interpreter's end.
            _point_at_nothing(self.fileno())
            if error.errno != errno.EPIPE and self._is_result:
                from genre_tasks.errors import ResourceError

                name = errno.errorcode.get(error.errno or 0, type(error).__name__)
                raise ResourceError(
                    f"the output cannot be written to stdout ({name}: {error.strerror})",
                    remedy="Send it elsewhere; what was computed is kept.",
                ) from error
        return count


class _AsciiText(io.TextIOWrapper):
    """A text stream in ASCII that does not say so: click takes such a stream for a mistake and writes UTF-8 into it."""

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """The smallest encoding that is a superset of the real one."""
        return "latin-1"


def _prepare_output(stream: TextIO | None, is_result: bool) -> TextIO:
    if stream is None:
        return Path(os.devnull).open("w", encoding="utf-8", errors="replace")
    try:
        raw = _ForgivingFile(stream.fileno(), is_result)
    except (OSError, ValueError, AttributeError):
        # An object without a descriptor, as tests put in place of a stream, takes any text.
        return stream
    is_unbuffered = bool(getattr(stream, "write_through", False))
    is_ascii = codecs.lookup(stream.encoding).name == "ascii"
    return (_AsciiText if is_ascii else io.TextIOWrapper)(
        raw if is_unbuffered else io.BufferedWriter(raw),  # type: ignore[arg-type]
        encoding=stream.encoding,
        errors="replace",
        line_buffering=bool(getattr(stream, "line_buffering", False)),
        write_through=is_unbuffered,
    )


def _open_if_closed(descriptor: int) -> None:
    """Opens the null device under a number that is free; the next file to be opened would get it otherwise."""
    try:
        os.fstat(descriptor)
    except OSError:
        _point_at_nothing(descriptor)


def _point_at_nothing(descriptor: int) -> None:
    null = os.open(os.devnull, os.O_RDWR)
    if null == descriptor:
        os.set_inheritable(descriptor, True)
        return
    os.dup2(null, descriptor)
    os.close(null)
