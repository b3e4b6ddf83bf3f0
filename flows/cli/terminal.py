"""Progress on the terminal: one live line for each stage."""

from __future__ import annotations

import sys
import time
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

import typer

from flows.cli.outcome import add_stage, print_unfinished
from flows.cli.signals import Interrupted
from flows.cli.streams import is_rewritable, terminal_width

if TYPE_CHECKING:
    from types import TracebackType

    from flows.pipeline.stage_runner import ArtifactRef

_LIVE_PERIOD_S = 0.2
_PLAIN_PERIOD_S = 10.0


class TerminalReporter:
    """Reports progress on stderr: a line that rewrites itself on a terminal, a line every ten seconds elsewhere.

    To be used in a ``with`` statement; Ctrl-C in it, and any other signal to stop, ends the command.

    Args:
        title: what is shown until the first stage or part starts.
        prefect: a context in which flows run; nothing for a command without flows.
    """

    def __init__(self, title: str, prefect: AbstractContextManager[None] | None = None) -> None:
        self._is_live = is_rewritable(sys.stderr)
        self._title = title
        self._prefect = prefect or nullcontext()
        self._start_s = time.monotonic()
        self._last_line_s = self._start_s
        # Steps of the current part, and how many were done when they were first reported, at which time.
        self._total = -1
        self._first_done = 0
        self._first_report_s = 0.0

    def __enter__(self) -> TerminalReporter:
        self._write(self._title, end=not self._is_live)
        self._prefect.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._prefect.__exit__(kind, error, traceback)
        if self._is_live:
            self._write("")
        if isinstance(error, Interrupted):
            self.stopped(error.exit_status)
            raise typer.Exit(error.exit_status)

    def stopped(self, exit_status: int) -> None:
        """Writes that the command was stopped and how to go on.

        Args:
            exit_status: of the command.
        """
        self._write("stopped; what is finished is kept: run the same command again to go on", end=True)
        print_unfinished("interrupted", exit_status)

    def stage_started(self, stage: str, chunk: int) -> None:
        """Starts the line of a stage."""
        self.part_started(f"chunk {chunk}  {stage}")

    def progress(self, done: int, total: int, note: str = "") -> None:
        """Shows how far the stage or part is and how long it will still take, if the last line is old enough."""
        now = time.monotonic()
        if total != self._total:
            # Steps that an earlier run did before it was stopped say nothing about the speed now.
            self._total = total
            self._first_done = done
            self._first_report_s = now
        if now - self._last_line_s < (_LIVE_PERIOD_S if self._is_live else _PLAIN_PERIOD_S):
            return
        self._last_line_s = now
        remaining = ""
        new_steps = done - self._first_done
        if new_steps > 0:
            left_s = (now - self._first_report_s) / new_steps * (total - done)
            remaining = f"  {left_s:.0f} s left"
        # On a terminal this rewrites the line; in a file it is one more line every ten seconds.
        self._write(f"{self._title}  {done}/{total}  {note}{remaining}", end=not self._is_live)

    def stage_ended(self, stage: str, chunk: int, ref: ArtifactRef) -> None:
        """Ends the line of a stage, with its seconds; the artifact's note follows as a warning."""
        add_stage(chunk, stage, ref.key, ref.cached)
        seconds = time.monotonic() - self._start_s
        outcome = "from the cache" if ref.cached else f"computed in {seconds:.1f} s"
        self._write(f"chunk {chunk}  {stage:<18} {outcome}", end=True)
        if ref.note:
            self._write(f"  warning: {ref.note}", end=True)

    def part_started(self, title: str) -> None:
        """Starts the line of a part."""
        self._start_s = time.monotonic()
        self._last_line_s = self._start_s
        self._title = title
        self._total = -1
        if self._is_live:
            self._write(title)

    def part_ended(self, outcome: str) -> None:
        """Ends the line of a part, with its seconds."""
        self._write(f"{self._title:<28} {outcome} in {time.monotonic() - self._start_s:.1f} s", end=True)

    def message(self, text: str) -> None:
        """Writes a line of its own."""
        self._write(text, end=True)

    def _write(self, text: str, end: bool = False) -> None:
        if self._is_live:
            # Back to the line's start, and delete what is on it; in one write, so that the line does not flicker.
            line = f"{text}\n" if end else _shorten(text)
            sys.stderr.write(f"\r\x1b[2K{line}")
        else:
            sys.stderr.write(f"{text}\n")
        sys.stderr.flush()


def report_on_terminal(title: str = "starting Prefect") -> TerminalReporter:
    """Makes a reporter that receives the events of all runs in this process, connected to Prefect while it is entered.

    Args:
        title: what is shown until the first stage or part starts.

    Returns:
        The reporter, to be used in a ``with`` statement.
    """
    from flows.pipeline.progress import set_reporter
    from flows.prefect_api.connection import connect_to_prefect

    reporter = TerminalReporter(title, connect_to_prefect())
    set_reporter(reporter)
    return reporter


def _shorten(text: str) -> str:
    """The text in one line of the terminal: a longer one would leave its first part behind when it is rewritten."""
    from rich.cells import cell_len, set_cell_size

    # A cell less than the terminal has: some terminals break the line once the last one is written.
    width = terminal_width(sys.stderr) - 1
    return text if cell_len(text) <= width else f"{set_cell_size(text, width - 3)}..."
