"""What a benchmark is: cells that are measured one by one, and the claims and the table made of their rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from benchmarks.common.claims import Claim

Row = dict[str, Any]


class NotMeasuredError(Exception):
    """Raised by a cell that this machine cannot measure; the message says why, and becomes its row."""


@dataclass(frozen=True)
class Cell:
    """The smallest thing that is measured, kept and resumed.

    ``parameters`` (JSON values) say what is measured, as far as the name and the code do not; ``seconds`` is a
    prediction.
    """

    name: str
    seconds: float
    measure: Callable[[], Row]
    parameters: Mapping[str, Any] = field(default_factory=dict)


def logs_of(options: Mapping[str, str]) -> list[tuple[str, int]]:
    """URI and chunk of each log that the options name: chunk 0 of streets of the ``seeds``, chunk 1 of ``pandaset``.

    An empty ``pandaset`` leaves the real log out.
    """
    logs = [(f"synthetic:street?seed={seed}", 0) for seed in options["seeds"].split(",") if seed]
    return logs + ([(f"pandaset:{options['pandaset']}", 1)] if options["pandaset"] else [])


class Bench(Protocol):
    """One set of claims."""

    name: str
    options: Mapping[str, str]  # what --set may change, with defaults
    code: tuple[str, ...]  # modules whose closure a cell's key covers

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """What is measured, in order; ``quick`` takes fewer runs."""
        ...

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """The claims, of the rows by cell; a row with ``not_measured`` has nothing else to read."""
        ...

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Lines of Markdown."""
        ...
