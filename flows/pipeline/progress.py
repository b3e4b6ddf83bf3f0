"""How a run reports what it does: to the terminal, to a log, or to nobody, as the caller chooses."""

from __future__ import annotations

import logging
import time
from typing import Protocol

from flows.observability.log_records import prepare_logs
from flows.pipeline.stage_runner import ArtifactRef

_log = logging.getLogger("genre")
# A worker's root logger stands at WARNING and would drop what a run reports.
if _log.level == logging.NOTSET:
    _log.setLevel(logging.INFO)
# Here, as every process that runs stages imports this, and a worker's process offers no earlier door.
prepare_logs()


class Reporter(Protocol):
    """Receives the events of a run; an implementation decides what to show."""

    def stage_started(self, stage: str, chunk: int) -> None:
        """A stage of a chunk starts.

        Args:
            stage: the stage's name.
            chunk: number of the chunk.
        """
        ...

    def progress(self, done: int, total: int, note: str = "") -> None:
        """The current stage or part has advanced; has the shape of ``genre_tasks.progress.Progress``.

        Args:
            done: steps that are done, from 0 to ``total``.
            total: all steps.
            note: what the step was about, a few words.
        """
        ...

    def stage_ended(self, stage: str, chunk: int, ref: ArtifactRef) -> None:
        """A stage of a chunk has ended.

        Args:
            stage: the stage's name.
            chunk: number of the chunk.
            ref: its artifact; ``ref.cached`` says whether it came from the store.
        """
        ...

    def part_started(self, title: str) -> None:
        """A part of a longer job starts, such as one cell of a sweep or one section of a training.

        Args:
            title: what the part is, a few words.
        """
        ...

    def part_ended(self, outcome: str) -> None:
        """The part that was started last has ended.

        Args:
            outcome: how it ended, a few words.
        """
        ...

    def message(self, text: str) -> None:
        """Tells the user something between parts.

        Args:
            text: one line.
        """
        ...


class LogReporter:
    """Writes to the logger ``genre``: a line for each event, and progress at most every few seconds.

    Args:
        every_s: seconds between two lines of progress.
    """

    def __init__(self, every_s: float = 10.0) -> None:
        self._every_s = every_s
        self._last_line_s = 0.0
        self._title = ""

    def stage_started(self, stage: str, chunk: int) -> None:
        """Writes that a stage starts."""
        self._last_line_s = time.monotonic()
        _log.info("chunk %d %s: started", chunk, stage)

    def progress(self, done: int, total: int, note: str = "") -> None:
        """Writes how far the stage is, if the last line is old enough."""
        # A stage reports every iteration; a worker's log is not to have a line for each.
        if time.monotonic() - self._last_line_s >= self._every_s:
            self._last_line_s = time.monotonic()
            _log.info("%d/%d %s", done, total, note)

    def stage_ended(self, stage: str, chunk: int, ref: ArtifactRef) -> None:
        """Writes how a stage ended, with the artifact's note if it has one."""
        outcome = "cached" if ref.cached else "done"
        if ref.note:
            outcome += f" ({ref.note})"
        _log.info("chunk %d %s: %s", chunk, stage, outcome)

    def part_started(self, title: str) -> None:
        """Writes that a part starts."""
        self._last_line_s = time.monotonic()
        self._title = title
        _log.info("%s: started", title)

    def part_ended(self, outcome: str) -> None:
        """Writes how the part ended."""
        _log.info("%s: %s", self._title, outcome)

    def message(self, text: str) -> None:
        """Writes the message."""
        _log.info("%s", text)


# One reporter for the process: Prefect passes plain values to tasks, so a reporter cannot travel as an argument.
_reporter: Reporter = LogReporter()


def get_reporter() -> Reporter:
    """Gives the reporter of this process; until one is set it writes to the log.

    Returns:
        The reporter that :func:`set_reporter` was given last.
    """
    return _reporter


def set_reporter(reporter: Reporter) -> None:
    """Chooses who receives the events of all runs in this process.

    Args:
        reporter: the new receiver.
    """
    global _reporter
    _reporter = reporter
