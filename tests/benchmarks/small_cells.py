"""A benchmark of two cells whose numbers a test sets, and which writes down what it measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from benchmarks.common.bench import Cell, Row, SmallestForm
from benchmarks.common.claims import Claim, claim


class Tiny:
    """``meet`` is called with the cell's name before it is measured, and may raise."""

    name = "tiny"
    code: tuple[str, ...] = ("tests.benchmarks.small_cells",)
    smallest = SmallestForm({}, "first")

    def __init__(self) -> None:
        self.options: Mapping[str, str] = {"size": "1"}
        self.measured: list[str] = []
        self.numbers = {"first": 3.0, "second": 5.0}
        self.meet: Callable[[str], Any] = lambda name: None

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        def measure(name: str) -> Row:
            self.meet(name)
            self.measured.append(name)
            return {"number": self.numbers[name]}

        parameters = {"size": options["size"], "quick": quick}
        return [Cell(n, 60.0, lambda n=n: measure(n), parameters) for n in self.numbers]

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        for name, row in rows.items():
            yield claim(f"tiny.{name}", row.get("number"), "<=", 4.0, "s", "two cells")

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        yield "| " + " | ".join(str(row.get("number")) for row in rows.values()) + " |"


BENCH = Tiny()
