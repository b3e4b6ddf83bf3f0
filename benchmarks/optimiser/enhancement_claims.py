"""From rows to the claims of how far GNet goes, of distillation and of enhancement."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import place
from benchmarks.common.over_cells import over_cells, where

SHIFTS = ("1", "2", "3", "4", "5")


def of_kind(rows: Mapping[str, Row], kind: str) -> list[Row]:
    """The measured rows of the cells ``kind/…``."""
    return [row for name, row in rows.items() if name.startswith(f"{kind}/") and "not_measured" not in row]


def distilled(rows: Mapping[str, Row], family: str) -> list[Row]:
    """The distillations that have the family; of a log's and order's several cells that have it the last."""
    found = [row for row in of_kind(rows, "distillation") if family in row]
    return list({(row["log"], row["chunk"], row["order"]): row for row in found}.values())


def claims(rows: Mapping[str, Row]) -> Iterator[Claim]:
    """Every claim; those without a row say that they were not measured."""
    yield _converged(of_kind(rows, "converged"))
    yield _distillation(distilled(rows, "adam"), "adam", "distillation", "tuned Adam", 0.5)
    recipe = distilled(rows, "standard")
    yield _distillation(recipe, "standard", "distillation_standard", "the standard recipe", 0.1)
    enhanced = of_kind(rows, "enhancement")
    for shift in SHIFTS:
        bad = [place(row) for row in enhanced if not better(row, shift)]
        share = None if not enhanced else 1 - len(bad) / len(enhanced)
        note = "share of cells where ENet is better than GNet (synthetic: PSNR and perceptual distance; real: kernel "
        note += f"distance, 95 % interval of the difference below 0); not in: {', '.join(bad) or 'none'}"
        name = f"optimiser.enhance_{shift}m"
        yield claim(name, share, ">=", 1.0, "share", f"{note}; {where(enhanced)}", len(enhanced))
    note = "mean distance over five shifts (synthetic: perceptual; real: kernel), the part of GNet's that ENet takes "
    note += "away less the part that GNet's network takes away in ENet's place"
    gains = [reduction(row, "enet") - reduction(row, "gnet_again") for row in enhanced]
    yield over_cells("enet_vs_gnet", gains, ">", 0.0, "of GNet's distance", f"{note}; {where(enhanced)}")
    losses = [row["heldout_psnr"]["enet"] - row["heldout_psnr"]["gnet"] for row in enhanced]
    note = "held-out PSNR, ENet's less GNet's, the worst cell"
    yield over_cells("interpolation", losses, ">=", -0.3, "dB", f"{note}; {where(enhanced)}", min)


def better(row: Row, shift: str) -> bool:
    """Whether ENet's scene is better than GNet's at this shift, in all that is measured there."""
    at = row["shifts"][shift]
    before, after = at["gnet"], at["enet"]
    if "kernel" in after:
        return after["high"] is not None and after["high"] < 0
    return bool(after["psnr"] > before["psnr"] and after["perceptual"] < before["perceptual"])


def reduction(row: Row, name: str) -> float:
    """By which part the mean distance over the shifts is below GNet's."""
    means = {}
    for scene in ("gnet", name):
        values = [at[scene].get("kernel", at[scene].get("perceptual")) for at in row["shifts"].values()]
        means[scene] = sum(values) / len(values)
    return 1 - means[name] / means["gnet"]


def times_adam(row: Row) -> float:
    """GNet's time to tuned Adam's converged PSNR over Adam's own; the cap where GNet never gets there."""
    reached = row["gnet"]["reached_s"]
    return float(row["cap"]) if reached is None else reached / row["adam_s"]


def times_distillation(row: Row, family: str) -> float:
    """ENet's time over that of the family's first run to be as good as its best; the cap where ENet is not so good.

    The cap also bounds the ratio where distillation was at its best at once, and brought next to nothing.
    """
    found, cap = row[family], float(row["cap"])
    return min(row["enet"][0] / found["reached_s"], cap) if found["enet_as_good"] else cap


def _converged(rows: Sequence[Row]) -> Claim:
    never = [row for row in rows if row["gnet"]["reached_s"] is None]
    note = "preset long: wall time to within 0.2 dB of tuned Adam's converged held-out PSNR over tuned Adam's own time "
    note += f"to there; in {len(never)} of {len(rows)} cells GNet never got there, and the cap counts as the ratio"
    for row in never:
        note += f"; {place(row)}: GNet {row['gnet']['best_psnr']:.2f} dB, Adam {row['plateau']:.2f} dB"
    return over_cells("converged", [times_adam(r) for r in rows], "<=", 0.5, "ratio", f"{note}; {where(rows)}")


def _distillation(rows: Sequence[Row], family: str, name: str, words: str, target: float) -> Claim:
    missed = [place(row) for row in rows if not row[family]["enet_as_good"]]
    note = f"ENet's wall time over that of distillation by {words} to the same quality at 3 m (kernel distance within "
    note += f"1 %, synthetic PSNR within 0.1 dB of the best that it came to); in {len(missed)} of {len(rows)} cells "
    note += f"ENet does not reach it, and the cap counts as the ratio ({', '.join(missed) or 'none'})"
    if rows:
        never = sum(row[family]["as_good_as_enet_s"] is None for row in rows)
        note += f"; in {never} it never came to ENet's own"
    ratios = [times_distillation(row, family) for row in rows]
    if early := [row for row in rows if row[family].get("enet_first_s") is not None]:
        first = [row[family]["enet_first_s"] / row[family]["reached_s"] for row in early]
        lengths = ", ".join(early[0]["enet_shorter"])
        note += f"; the first of its lengths ({lengths} and its own) that is as good: {statistics.median(first):.3f} "
        note += f"({min(first):.3f}–{max(first):.3f}, {len(first)} cells)"
    return over_cells(name, ratios, "<=", target, "ratio", f"{note}; {where(rows)}")
