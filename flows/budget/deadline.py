"""The time that a run may take, and how much of it is left."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Deadline:
    """Counts the wall time that a run has used of its budget; time in :meth:`paused` does not count.

    Args:
        budget_s: seconds that the run may take.
        start_time: when the run began, in seconds since the epoch; now by default.

    >>> deadline = Deadline(60.0)
    >>> 59.0 < deadline.left_s <= 60.0
    True
    """

    def __init__(self, budget_s: float, start_time: float | None = None) -> None:
        self.budget_s = budget_s
        used_s = 0.0 if start_time is None else max(time.time() - start_time, 0.0)
        # The wall clock is read once, as it jumps where it is corrected.
        self._start_s = time.monotonic() - used_s
        self._paused_s = 0.0

    @property
    def used_s(self) -> float:
        """Seconds that the run has used so far."""
        return time.monotonic() - self._start_s - self._paused_s

    @property
    def left_s(self) -> float:
        """Seconds that are left; negative once the budget is spent."""
        return self.budget_s - self.used_s

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stops the count for a block that is not the run's own work, such as evaluation."""
        pause_start_s = time.monotonic()
        try:
            yield
        finally:
            # Also after an error, so that the time left stays right for whoever handles it.
            self._paused_s += time.monotonic() - pause_start_s
