"""Who is told how a run goes: a reporter, chosen by the caller (the terminal, a log, nobody)."""

from __future__ import annotations

import logging
import time
from typing import Protocol

from flows.pipeline.stage_runner import ArtifactRef

_log = logging.getLogger("genre")
if _log.level == logging.NOTSET:  # else a worker's root logger, at WARNING, would drop what a run says
    _log.setLevel(logging.INFO)


class Reporter(Protocol):
    """Told when stages start, advance and end; ``progress`` has the shape of ``genre_tasks.progress.Progress``."""

    def stage_started(self, stage: str, chunk: int) -> None: ...

    def progress(self, done: int, total: int, note: str = "") -> None: ...

    def stage_ended(self, stage: str, chunk: int, ref: ArtifactRef) -> None: ...

    def began(self, what: str) -> None:
        """A part of a training."""
        ...

    def ended(self, outcome: str) -> None: ...

    def said(self, text: str) -> None:
        """Something the user should know, between parts."""
        ...


class LogReporter:
    """Writes one log line per stage and per ``every_s`` seconds of progress: what a worker does."""

    def __init__(self, every_s: float = 10.0) -> None:
        self._every_s = every_s
        self._said = 0.0
        self._what = ""

    def stage_started(self, stage: str, chunk: int) -> None:
        self._said = time.monotonic()
        _log.info("chunk %d %s: started", chunk, stage)

    def progress(self, done: int, total: int, note: str = "") -> None:
        if time.monotonic() - self._said >= self._every_s:
            self._said = time.monotonic()
            _log.info("%d/%d %s", done, total, note)

    def stage_ended(self, stage: str, chunk: int, ref: ArtifactRef) -> None:
        _log.info(
            "chunk %d %s: %s%s", chunk, stage, "cached" if ref.cached else "done", f" ({ref.note})" * bool(ref.note)
        )

    def began(self, what: str) -> None:
        self._said, self._what = time.monotonic(), what
        _log.info("%s: started", what)

    def ended(self, outcome: str) -> None:
        _log.info("%s: %s", self._what, outcome)

    def said(self, text: str) -> None:
        _log.info("%s", text)


_current: Reporter = LogReporter()


def current_reporter() -> Reporter:
    """The reporter of this process."""
    return _current


def report_to(reporter: Reporter) -> None:
    """Makes ``reporter`` the one that this process's runs tell."""
    global _current
    _current = reporter
