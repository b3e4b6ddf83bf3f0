"""From rows to the claims of how far GNet goes, of distillation and of enhancement."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import cell_label
from benchmarks.common.over_cells import cell_labels, claim_over_cells

SHIFTS = ("1", "2", "3", "4", "5")


def rows_of_kind(rows: Mapping[str, Row], kind: str) -> list[Row]:
    """Finds the measured rows of a kind of cells.

    Args:
        rows: of the benchmark, by cell.
        kind: what the cells' names begin with, before the slash.

    Returns:
        Rows in the order of the cells.

    >>> rows_of_kind({"converged/a": {"n": 1}, "converged/b": {"not_measured": "no time"}}, "converged")
    [{'n': 1}]
    """
    return [row for name, row in rows.items() if name.startswith(f"{kind}/") and "not_measured" not in row]


def distillation_rows(rows: Mapping[str, Row], family: str) -> list[Row]:
    """Finds the distillations of a family.

    Args:
        rows: of the benchmark, by cell.
        family: one of ``FAMILIES``.

    Returns:
        One row for each log and order.
    """
    # A family that was measured again has a cell of its own behind the first one: the last one counts.
    found = [row for row in rows_of_kind(rows, "distillation") if family in row]
    return list({(row["log"], row["chunk"], row["order"]): row for row in found}.values())


def claims(rows: Mapping[str, Row]) -> Iterator[Claim]:
    """Makes every claim; those without a row say that they were not measured.

    Args:
        rows: of the benchmark, by cell.

    Yields:
        Claim: each once.
    """
    yield _converged(rows_of_kind(rows, "converged"))
    yield _distillation(distillation_rows(rows, "adam"), "adam", "distillation", "tuned Adam", 0.5)
    recipe = distillation_rows(rows, "standard")
    yield _distillation(recipe, "standard", "distillation_standard", "the standard recipe", 0.1)
    enhanced = rows_of_kind(rows, "enhancement")
    for shift in SHIFTS:
        bad = [cell_label(row) for row in enhanced if not is_better(row, shift)]
        fraction = None if not enhanced else 1 - len(bad) / len(enhanced)
        note = "share of cells where ENet is better than GNet (synthetic: PSNR and perceptual distance; real: kernel "
        note += f"distance, 95 % interval of the difference below 0); not in: {', '.join(bad) or 'none'}"
        name = f"optimiser.enhance_{shift}m"
        yield claim(name, fraction, ">=", 1.0, "share", f"{note}; {cell_labels(enhanced)}", len(enhanced))
    note = "mean distance over five shifts (synthetic: perceptual; real: kernel), the part of GNet's that ENet takes "
    note += "away less the part that GNet's network takes away in ENet's place"
    gains = [distance_reduction(row, "enet") - distance_reduction(row, "gnet_again") for row in enhanced]
    yield claim_over_cells("enet_vs_gnet", gains, ">", 0.0, "of GNet's distance", f"{note}; {cell_labels(enhanced)}")
    # Enhancement must not be paid for on the path: the worst cell counts, not the median.
    losses = [row["heldout_psnr"]["enet"] - row["heldout_psnr"]["gnet"] for row in enhanced]
    note = "held-out PSNR, ENet's less GNet's, the worst cell"
    yield claim_over_cells("interpolation", losses, ">=", -0.3, "dB", f"{note}; {cell_labels(enhanced)}", min)


def is_better(row: Row, shift: str) -> bool:
    """Whether ENet's scene is better than GNet's in everything that is measured at a shift.

    Args:
        row: of a cell of enhancement.
        shift: metres, as in the row.

    Returns:
        On a real log, whether the 95 % interval of the difference lies below 0.
    """
    scores = row["shifts"][shift]
    before = scores["gnet"]
    after = scores["enet"]
    if "kernel" in after:
        return after["high"] is not None and after["high"] < 0
    return bool(after["psnr"] > before["psnr"] and after["perceptual"] < before["perceptual"])


def distance_reduction(row: Row, name: str) -> float:
    """Computes by which fraction the mean distance over the shifts is below GNet's.

    Args:
        row: of a cell of enhancement.
        name: of the scene.

    Returns:
        At most 1; negative where the scene is farther from the truth than GNet's.
    """
    # Streets have the perceptual distance to the truth, real logs the kernel distance.
    means = {}
    for scene in ("gnet", name):
        values = [at[scene].get("kernel", at[scene].get("perceptual")) for at in row["shifts"].values()]
        means[scene] = sum(values) / len(values)
    return 1 - means[name] / means["gnet"]


def time_ratio_to_adam(row: Row) -> float:
    """Divides GNet's time to tuned Adam's converged PSNR by tuned Adam's time.

    Args:
        row: of a cell of convergence.

    Returns:
        The ratio; the cap where GNet never gets there.
    """
    reached = row["gnet"]["reached_s"]
    return float(row["cap"]) if reached is None else reached / row["adam_s"]


def time_ratio_to_distillation(row: Row, family: str) -> float:
    """Divides ENet's time by that of distillation to its best quality.

    Args:
        row: of a cell of distillation.
        family: one of ``FAMILIES``.

    Returns:
        The ratio; the cap where ENet is not as good.
    """
    found = row[family]
    cap = float(row["cap"])
    # The cap also bounds the ratio where distillation was at its best at once, and brought next to nothing.
    return min(row["enet"][0] / found["reached_s"], cap) if found["enet_as_good"] else cap


def _converged(rows: Sequence[Row]) -> Claim:
    # Both plateaus are in the claim's text: a ratio at the cap does not say how much was missing.
    never = [row for row in rows if row["gnet"]["reached_s"] is None]
    note = "preset long: wall time to within 0.2 dB of tuned Adam's converged held-out PSNR over tuned Adam's own time "
    note += f"to there; in {len(never)} of {len(rows)} cells GNet never got there, and the cap counts as the ratio"
    for row in never:
        note += f"; {cell_label(row)}: GNet {row['gnet']['best_psnr']:.2f} dB, Adam {row['plateau']:.2f} dB"
    return claim_over_cells(
        "converged", [time_ratio_to_adam(r) for r in rows], "<=", 0.5, "ratio", f"{note}; {cell_labels(rows)}"
    )


def _distillation(rows: Sequence[Row], family: str, name: str, words: str, target: float) -> Claim:
    # Named in the claim, because a ratio at the cap hides which log failed.
    missed = [cell_label(row) for row in rows if not row[family]["enet_as_good"]]
    note = f"ENet's wall time over that of distillation by {words} to the same quality at 3 m (kernel distance within "
    note += f"1 %, synthetic PSNR within 0.1 dB of the best that it came to); in {len(missed)} of {len(rows)} cells "
    note += f"ENet does not reach it, and the cap counts as the ratio ({', '.join(missed) or 'none'})"
    if rows:
        never = sum(row[family]["as_good_as_enet_s"] is None for row in rows)
        note += f"; in {never} it never came to ENet's own"
    ratios = [time_ratio_to_distillation(row, family) for row in rows]
    if early := [row for row in rows if row[family].get("enet_first_s") is not None]:
        first = [row[family]["enet_first_s"] / row[family]["reached_s"] for row in early]
        lengths = ", ".join(early[0]["enet_shorter"])
        note += f"; the first of its lengths ({lengths} and its own) that is as good: {statistics.median(first):.3f} "
        note += f"({min(first):.3f}–{max(first):.3f}, {len(first)} cells)"
    return claim_over_cells(name, ratios, "<=", target, "ratio", f"{note}; {cell_labels(rows)}")
