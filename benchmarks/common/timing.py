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
class Measured:
    """Median and first and third quartile of n measurements."""

    median: float
    low: float
    high: float
    n: int

    @property
    def spread(self) -> tuple[float, float]:
        return self.low, self.high

    @staticmethod
    def of(values: Sequence[float]) -> Measured:
        """Raises ``ValueError`` for none."""
        low, median, high = np.percentile(values, [25, 50, 75]).tolist()
        return Measured(median, low, high, len(values))

    def as_row(self, scale: float = 1.0) -> dict[str, float]:
        """As JSON, times ``scale``."""
        return {"median": self.median * scale, "low": self.low * scale, "high": self.high * scale, "n": self.n}


def take_turns(actions: Mapping[str, Action], rounds: int) -> dict[str, list[float]]:
    """Seconds of each action by :func:`seconds_of`, one number a round.

    Every action is called once beforehand. The order turns around from round to round, so that none always follows
    the same one.
    """
    for action in actions.values():
        action()
    seconds: dict[str, list[float]] = {name: [] for name in actions}
    for i in range(rounds):
        for name in list(actions)[:: -1 if i % 2 else 1]:
            seconds[name].append(seconds_of(actions[name]))
    return seconds


def seconds_of(action: Action, at_least_s: float = 0.2) -> float:
    """The median of as many calls as fill ``at_least_s``, one where a call is longer."""
    calls: list[float] = []
    while sum(calls) < at_least_s:
        start = time.perf_counter()
        action()
        calls.append(time.perf_counter() - start)
    return statistics.median(calls)


def ratio(above: Sequence[float], below: Sequence[float]) -> Measured:
    """Of two actions that took turns: the quotient of each round."""
    return Measured.of([a / b for a, b in zip(above, below, strict=True)])


def on_threads(threads: int, action: Action) -> Action:
    """The action with torch's own operations on so many threads."""

    def run() -> None:
        torch.set_num_threads(threads)
        action()

    return run
