"""The time that a run may take, and what of it is left."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Clock:
    """Counts wall time from ``began`` (seconds since the epoch), without what is spent in :meth:`paused`."""

    def __init__(self, budget_s: float, began: float | None = None) -> None:
        self.budget_s = budget_s
        self._began = time.time() if began is None else began
        self._paused = 0.0

    @property
    def used_s(self) -> float:
        return time.time() - self._began - self._paused

    @property
    def left_s(self) -> float:
        """Negative where the budget is spent."""
        return self.budget_s - self.used_s

    @contextmanager
    def paused(self) -> Iterator[None]:
        """What is not the run's own work: evaluation."""
        before = time.time()
        try:
            yield
        finally:
            self._paused += time.time() - before
