"""From rows to claims: a ratio for each log and order, and the median over them.

Claims beyond the race are in :mod:`benchmarks.optimiser.enhancement_claims`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import cell_label
from benchmarks.common.over_cells import cell_labels, claim_over_cells
from benchmarks.optimiser import enhancement_claims


def race_rows(rows: Mapping[str, Row], method: str) -> list[Row]:
    """Finds the measured races of one method.

    Args:
        rows: of the benchmark, by cell.
        method: as in the row.

    Returns:
        Rows in the order of the cells.
    """
    return [row for row in rows.values() if row.get("method") == method]


def time_ratio_to_gnet(row: Row) -> tuple[float, bool]:
    """Divides the earliest variant's time to GNet's PSNR by GNet's time.

    Args:
        row: of a race.

    Returns:
        The ratio, and whether a variant got there; where none did, the ratio is the cap.

    >>> time_ratio_to_gnet({"variants": {"a": {"reached_s": 6.0}}, "gnet": {"seconds": 2.0}, "cap": 50})
    (3.0, True)
    """
    # The quickest variant counts, so that the rival is tuned to each log and GNet is not.
    found = [v["reached_s"] for v in row["variants"].values() if v["reached_s"] is not None]
    return (min(found) / row["gnet"]["seconds"], True) if found else (float(row["cap"]), False)


def gain_at_equal_renders(row: Row) -> float | None:
    """Subtracts the best variant's PSNR at as many renders from GNet's.

    Args:
        row: of a race.

    Returns:
        dB; ``None`` where no variant made so many renders.
    """
    found = [v["psnr_at_equal_renders"] for v in row["variants"].values() if v["psnr_at_equal_renders"] is not None]
    return row["gnet"]["psnr"] - max(found) if found else None


def claims(rows: Mapping[str, Row]) -> Iterator[Claim]:
    """Makes every claim; those without a row say that they were not measured.

    Args:
        rows: of the benchmark, by cell.

    Yields:
        Claim: each once.
    """
    for method, name, target in (("standard_3dgs", "vs_standard_3dgs", 10.0), ("tuned_adam", "vs_tuned_adam", 2.0)):
        ratios = [time_ratio_to_gnet(row) for row in race_rows(rows, method)]
        # A variant that never gets there counts with the cap: leaving it out would favour the slow.
        never = sum(not hit for _, hit in ratios)
        note = f"{method}, all variants: wall time to GNet's held-out PSNR over GNet's"
        note += f"; in {never} of {len(ratios)} cells not within the cap, which then counts"
        yield claim_over_cells(
            name, [r for r, _ in ratios], ">=", target, "ratio", f"{note}; {cell_labels(race_rows(rows, method))}"
        )
    adam = race_rows(rows, "tuned_adam")
    gains = [g for row in adam if (g := gain_at_equal_renders(row)) is not None]
    yield claim_over_cells(
        "equal_renders_db", gains, ">=", 1.5, "dB", f"to the best variant of tuned Adam; {cell_labels(adam)}"
    )
    # One unstable cell is a failure, whatever the others do: the worst counts.
    stable = [row for name, row in rows.items() if name.startswith("stability/") and "ratio" in row]
    note = "loss at 10 T over loss at T, steps past T at 0.05 of the rates; the worst cell, GNet's and ENet's alike"
    names = ", ".join(f"{row.get('network', 'gnet')} {cell_label(row)}" for row in stable) or "not measured"
    yield claim_over_cells("stable_10x", [r["ratio"] for r in stable], "<=", 1.02, "ratio", f"{note}; {names}", max)
    network = rows.get("network", {}).get("seconds", {}).get("100000")
    spread = None if network is None else (network["low"], network["high"])
    data = "100k Gaussians, features included, two threads"
    median = network and network["median"]
    count = network["n"] if network else 0
    yield claim("optimiser.network_100k", median, "<=", 0.5, "s", data, count, spread)
    yield from enhancement_claims.claims(rows)
