"""Pattern search over learning rates: settings, the moves between them, and the search that follows what helps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

from benchmarks.common.run_stages import print_progress
from genre_tasks.optimiser.tuned_adam import GNET_LEARNING_RATES

ENOUGH_DB = 0.02
"""A round that gains less ends the search."""


@dataclass(frozen=True)
class Setting:
    """One point of the search.

    Attributes:
        rates: learning rates of means, log scales, quaternions, opacities and colours.
        schedule: of the learning rates.
        relaxation: c₀ of a network's residuals; tuned Adam has none.
    """

    rates: tuple[float, ...] = GNET_LEARNING_RATES.as_tuple()
    schedule: Literal["cosine", "constant"] = "cosine"
    relaxation: float = 0.0

    def scaled(self, factor: float, which: int | None = None) -> Setting:
        """Multiplies one learning rate, or all.

        Args:
            factor: above 0.
            which: index of the rate; ``None``: all of them.

        Returns:
            Setting: another one, its rates rounded to four digits.

        >>> Setting((1.0, 2.0)).scaled(2.0, 1).rates
        (1.0, 4.0)
        """
        # Four digits make a factor and its inverse come back to the same setting, whose score is in the file already.
        rates = (r * factor if which in (None, k) else r for k, r in enumerate(self.rates))
        return replace(self, rates=tuple(float(f"{r:.4g}") for r in rates))

    def with_relaxation(self, more: float) -> Setting:
        """Adds to c₀.

        Args:
            more: what is added; negative lowers it.

        Returns:
            Setting: another one.
        """
        return replace(self, relaxation=round(self.relaxation + more, 4))

    def with_other_schedule(self) -> Setting:
        """Exchanges the cosine schedule for the constant one, or the other way round."""
        return replace(self, schedule="constant" if self.schedule == "cosine" else "cosine")


def moves(factor: float = 2.0) -> Iterator[Callable[[Setting], Setting]]:
    """Lists the moves of a search for tuned Adam: all rates at once, the schedule, then single rates.

    Args:
        factor: by which rates are multiplied or divided.

    Yields:
        Functions from a setting to its neighbour.
    """
    # Lower rates first: where all rates are far too high, changing a single one makes no difference.
    yield lambda s: s.scaled(1 / factor)
    yield lambda s: s.scaled(factor)
    yield Setting.with_other_schedule
    yield from single_rate_moves(factor)


def single_rate_moves(factor: float) -> Iterator[Callable[[Setting], Setting]]:
    """Lists the moves that multiply or divide one learning rate.

    Args:
        factor: by which a rate is multiplied or divided.

    Yields:
        Functions from a setting to its neighbour.
    """
    for which in range(len(GNET_LEARNING_RATES.as_tuple())):
        for multiplier in (factor, 1 / factor):
            yield partial(Setting.scaled, factor=multiplier, which=which)


def network_moves(factor: float) -> Iterator[Callable[[Setting], Setting]]:
    """Lists the moves of a search for a network, which has a schedule built in and may have a relaxation.

    Args:
        factor: by which rates are multiplied or divided.

    Yields:
        Functions from a setting to its neighbour.
    """
    yield from single_rate_moves(factor)
    for more in (math.log(factor), -math.log(factor)):
        yield partial(Setting.with_relaxation, more=more)


def search(
    measure: Callable[[Setting], float],
    start: Setting,
    rounds: int,
    ways: Callable[[], Iterable[Callable[[Setting], Setting]]] = moves,
) -> tuple[Setting, float]:
    """Searches for the best setting, one move at a time.

    Args:
        measure: score of a setting in dB, higher is better.
        start: where the search begins.
        rounds: how often all moves are tried at most.
        ways: lists the moves of a round.

    Returns:
        The best setting found, and its score.
    """
    best = start
    found = measure(start)
    for _ in range(rounds):
        before = found
        for move in ways():
            # A move that helped is repeated at once: the optimum is often several factors away.
            while (value := measure(move(best))) > found:
                best = move(best)
                found = value
                print_progress(f"{found:7.3f} dB  {best}")
        # A round costs a run for each move, so a gain this small does not pay for another one.
        if found - before < ENOUGH_DB:
            break
    return best, found
