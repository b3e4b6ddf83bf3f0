"""From rows to claims: a ratio for each log and order, the median over them. What lies beyond the race: ``beyond``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import place
from benchmarks.common.over_cells import over_cells, where
from benchmarks.optimiser import enhancement_claims


def races(rows: Mapping[str, Row], method: str) -> list[Row]:
    """The measured rows of one method."""
    return [row for row in rows.values() if row.get("method") == method]


def times_gnet(row: Row) -> tuple[float, bool]:
    """The earliest of the variants' times over GNet's, and whether it was reached; where none was, the cap stands."""
    found = [v["reached_s"] for v in row["variants"].values() if v["reached_s"] is not None]
    return (min(found) / row["gnet"]["seconds"], True) if found else (float(row["cap"]), False)


def gain_db(row: Row) -> float | None:
    """GNet's PSNR over that of the best variant at as many renders; ``None`` where no variant made so many."""
    found = [v["psnr_at_equal_renders"] for v in row["variants"].values() if v["psnr_at_equal_renders"] is not None]
    return row["gnet"]["psnr"] - max(found) if found else None


def claims(rows: Mapping[str, Row]) -> Iterator[Claim]:
    """Every claim; those without a row say that they were not measured."""
    for method, name, target in (("standard_3dgs", "vs_standard_3dgs", 10.0), ("tuned_adam", "vs_tuned_adam", 2.0)):
        ratios = [times_gnet(row) for row in races(rows, method)]
        never = sum(not hit for _, hit in ratios)
        note = f"{method}, all variants: wall time to GNet's held-out PSNR over GNet's"
        note += f"; in {never} of {len(ratios)} cells not within the cap, which then counts"
        yield over_cells(name, [r for r, _ in ratios], ">=", target, "ratio", f"{note}; {where(races(rows, method))}")
    adam = races(rows, "tuned_adam")
    gains = [g for row in adam if (g := gain_db(row)) is not None]
    yield over_cells("equal_renders_db", gains, ">=", 1.5, "dB", f"to the best variant of tuned Adam; {where(adam)}")
    stable = [row for name, row in rows.items() if name.startswith("stability/") and "ratio" in row]
    note = "loss at 10 T over loss at T, steps past T at 0.05 of the rates; the worst cell, GNet's and ENet's alike"
    names = ", ".join(f"{row.get('network', 'gnet')} {place(row)}" for row in stable) or "not measured"
    yield over_cells("stable_10x", [r["ratio"] for r in stable], "<=", 1.02, "ratio", f"{note}; {names}", max)
    m = rows.get("network", {}).get("seconds", {}).get("100000")
    spread = None if m is None else (m["low"], m["high"])
    data = "100k Gaussians, features included, two threads"
    yield claim("optimiser.network_100k", m and m["median"], "<=", 0.5, "s", data, m["n"] if m else 0, spread)
    yield from enhancement_claims.claims(rows)
