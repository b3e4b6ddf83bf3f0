"""Claims over several cells: medians, quartiles, and which cells they were measured on."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, Op, claim
from benchmarks.common.context import place
from benchmarks.common.timing import Measured


def over_cells(
    name: str,
    values: Sequence[float],
    op: Op,
    target: float,
    unit: str,
    data: str,
    pick: Callable[[Sequence[float]], float] | None = None,
    bench: str = "optimiser",
) -> Claim:
    """The median over the cells, or what ``pick`` takes; quartiles as the spread; not measured without a value."""
    if not values:
        return claim(f"{bench}.{name}", None, op, target, unit, data)
    m = Measured.of(values)
    return claim(f"{bench}.{name}", pick(values) if pick else m.median, op, target, unit, data, m.n, m.spread)


def where(rows: Sequence[Row]) -> str:
    """The cells by name."""
    return ", ".join(place(row) for row in rows) or "not measured"
