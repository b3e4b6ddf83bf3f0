"""Progress as an injected callback: stages report, the caller decides what to show."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called as ``progress(done, total, note)`` with ``0 <= done <= total``; must be cheap and must not raise."""

    def __call__(self, done: int, total: int, note: str = "") -> None: ...


def silent(done: int, total: int, note: str = "") -> None:
    """The default: says nothing."""
