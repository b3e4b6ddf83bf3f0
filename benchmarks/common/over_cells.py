"""Claims over several cells: medians, quartiles, and which cells they were measured on."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, Op, claim
from benchmarks.common.context import cell_label
from benchmarks.common.timing import Quartiles


def claim_over_cells(
    name: str,
    values: Sequence[float],
    op: Op,
    target: float,
    unit: str,
    data: str,
    pick: Callable[[Sequence[float]], float] | None = None,
    bench: str = "optimiser",
) -> Claim:
    """Makes a claim about one number of each cell.

    Args:
        name: of the claim, without the benchmark's.
        values: one of each cell that was measured.
        op: how the number has to compare with the target.
        target: in ``unit``.
        unit: of the values.
        data: what they were measured on.
        pick: chooses the claimed number of the values, such as ``min``; the median without it.
        bench: name of the benchmark.

    Returns:
        The claim with the quartiles as its spread; not measured without a value.

    >>> claim_over_cells("gain_db", [1.0, 2.0, 4.0], ">=", 1.5, "dB", "three streets").measured
    2.0
    """
    if not values:
        return claim(f"{bench}.{name}", None, op, target, unit, data)
    quartiles = Quartiles.from_values(values)
    # The median, because one odd street should not decide a claim.
    number = pick(values) if pick else quartiles.median
    return claim(f"{bench}.{name}", number, op, target, unit, data, quartiles.n, quartiles.spread)


def cell_labels(rows: Sequence[Row]) -> str:
    """Lists what rows were measured on.

    Args:
        rows: see :func:`benchmarks.common.context.cell_label`.

    Returns:
        Names with commas, or ``not measured`` without rows.
    """
    return ", ".join(cell_label(row) for row in rows) or "not measured"
