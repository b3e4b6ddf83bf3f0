"""Times of actions that take turns, so that drift of the machine meets all of them alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

Action = Callable[[], object]


@dataclass(frozen=True)
class Quartiles:
    """The quartiles of some measurements.

    Attributes:
        median: of the measurements.
        low: first quartile.
        high: third quartile.
        n: number of measurements.
    """

    median: float
    low: float
    high: float
    n: int

    @property
    def spread(self) -> tuple[float, float]:
        """First and third quartile."""
        return self.low, self.high

    @staticmethod
    def from_values(values: Sequence[float]) -> Quartiles:
        """Computes the quartiles.

        Raises:
            ValueError: there is no value.

        >>> Quartiles.from_values([1.0, 2.0, 3.0]).spread
        (1.5, 2.5)
        """
        low, median, high = np.percentile(values, [25, 50, 75]).tolist()
        return Quartiles(median, low, high, len(values))

    def as_row(self, scale: float = 1.0) -> dict[str, float]:
        """Gives the quartiles as JSON values.

        Args:
            scale: factor for another unit, such as 1e3 from seconds to milliseconds.

        Returns:
            ``median``, ``low``, ``high`` and ``n``.
        """
        return {"median": self.median * scale, "low": self.low * scale, "high": self.high * scale, "n": self.n}


def time_in_turns(actions: Mapping[str, Action], rounds: int) -> dict[str, list[float]]:
    """Times actions in rounds.

    Args:
        actions: by name; each is called once beforehand.
        rounds: how often each is timed.

    Returns:
        Seconds of a call, one number a round, by name; see :func:`median_call_seconds`.
    """
    # First calls import, allocate and compile, which no later call pays again.
    for action in actions.values():
        action()
    seconds: dict[str, list[float]] = {name: [] for name in actions}
    for i in range(rounds):
        # Every second round goes backwards: else an action would always run in the caches of the same other one.
        for name in list(actions)[:: -1 if i % 2 else 1]:
            seconds[name].append(median_call_seconds(actions[name]))
    return seconds


def median_call_seconds(action: Action, at_least_s: float = 0.2) -> float:
    """Times one action.

    Args:
        action: what to call.
        at_least_s: it is called until so many seconds are filled, at least once.

    Returns:
        The median seconds of a call.
    """
    calls: list[float] = []
    # Repeated until it fills a fifth of a second, far above the clock's resolution.
    while sum(calls) < at_least_s:
        start = time.perf_counter()
        action()
        calls.append(time.perf_counter() - start)
    # The median ignores the calls that the scheduler interrupted.
    return statistics.median(calls)


def ratio(above: Sequence[float], below: Sequence[float]) -> Quartiles:
    """Divides the times of two actions that took turns, round by round.

    Args:
        above: seconds of one action, one number a round.
        below: seconds of the other, of as many rounds.

    Returns:
        The quartiles of the quotients.

    >>> ratio([4.0, 6.0], [2.0, 2.0]).median
    2.5
    """
    # Round by round, because drift of the clock frequency cancels within a round.
    return Quartiles.from_values([a / b for a, b in zip(above, below, strict=True)])


def on_threads(threads: int, action: Action) -> Action:
    """Makes an action that first sets the number of torch's threads.

    Args:
        threads: for torch's own operations; the number stays set afterwards.
        action: what to call then.
    """

    def run() -> None:
        torch.set_num_threads(threads)
        action()

    return run
