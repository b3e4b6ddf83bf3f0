"""Progress as an injected callback: stages report, the caller decides what to show."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """What stages call to report how far they are; it must be cheap and must not raise."""

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Reports progress.

        Args:
            done: units of work that are done, ``0 <= done <= total``.
            total: all units of work.
            note: what is being done, in a few words.
        """
        # Implementations draw bars, write logs, or do nothing.
        ...


def silent(done: int, total: int, note: str = "") -> None:
    """Ignores progress, the default of every stage.

    Args:
        done: units of work that are done.
        total: all units of work.
        note: what is being done.

    >>> silent(3, 10)
    """
