"""The optimiser's rows as Markdown."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence

from benchmarks.common.bench import Row, list_not_measured
from benchmarks.common.context import cell_label
from benchmarks.optimiser import enhancement_claims


def markdown(rows: Mapping[str, Row]) -> Iterator[str]:
    """Makes the tables of the race, the network, convergence, distillation and enhancement.

    Args:
        rows: of the benchmark, by cell.

    Yields:
        Lines of Markdown, last what was not measured.
    """
    yield "| log | method | seconds | renders | best PSNR | at equal renders | reached GNet's PSNR after | × GNet |"
    yield "|---|---|---|---|---|---|---|---|"
    for row in (r for r in rows.values() if "variants" in r):
        yield from _race(row)
    if trades := [row["trade"] for row in rows.values() if "trade" in row]:
        yield ""
        yield from _trade(trades)
    network = rows.get("network", {})
    if "seconds" in network:
        yield ""
        yield "| Gaussians | evaluation of the network, s | adds at its peak, MiB | building the voxels once, s |"
        yield "|---|---|---|---|"
        for count, m in network["seconds"].items():
            times = f"{m['median']:.3f} ({m['low']:.3f}–{m['high']:.3f})"
            yield f"| {int(count):,} | {times} | {network['peak_mib'][count]:.0f} | {network['voxels_s'][count]:.2f} |"
        fit = network["fit"]
        line = f"{fit['seconds']:.3f} s + {fit['us_per_gaussian']:.2f} µs a Gaussian"
        yield f"| a line through them | {line} (R² {fit['r2']:.4f}) | | |"
    for rows_of, kind in ((_converged, "converged"), (_distillation, "distillation"), (_enhancement, "enhancement")):
        if found := enhancement_claims.rows_of_kind(rows, kind):
            yield ""
            yield from rows_of(found)
    for name, row in rows.items():
        if "ratio" in row:
            losses = ", ".join(f"{k} T: {v:.5f}" for k, v in row["loss"].items())
            name = {"gnet": "GNet", "enet": "ENet"}[row.get("network", "gnet")]
            yield f"\n{cell_label(row)}, {name} past its length: loss at {losses}; 10 T over T {row['ratio']:.4f}"
    yield from list_not_measured(rows)


def _race(row: Row) -> Iterator[str]:
    g = row["gnet"]
    yield f"| {cell_label(row)} | GNet | {g['seconds']:.1f} | {g['renders']} | {g['psnr']:.2f} | | | 1 |"
    for name, v in row["variants"].items():
        equal = v["psnr_at_equal_renders"]
        if v["reached_s"] is None:
            when = f"never ({v['ended']})"
            # Only a variant that was stopped by the cap has a lower bound of its time.
            times = f"≥ {row['cap']:g}" if v["ended"] == "cap" else ""
        else:
            when = f"{v['reached_s']:.1f} s"
            times = f"{v['reached_s'] / g['seconds']:.2f}"
        cells = (f"{v['ended_s']:.1f}", v["renders"], f"{v['best_psnr']:.2f}", "" if equal is None else f"{equal:.2f}")
        yield f"| | {row['method']} {name} | " + " | ".join(map(str, cells)) + f" | {when} | {times} |"


def _trade(rows: Sequence[Mapping[str, Mapping[str, float]]]) -> Iterator[str]:
    yield "| GNet, iterations x views, or beside the preset | seconds | renders | held-out PSNR | PSNR at 3 m |"
    yield "|---|---|---|---|---|"
    for name in rows[0]:
        seconds, renders, psnr, novel_psnr = (
            statistics.fmean(row[name][k] for row in rows) for k in ("seconds", "renders", "psnr", "psnr_3m")
        )
        yield f"| {name} | {seconds:.2f} | {renders:.0f} | {psnr:.2f} | {novel_psnr:.2f} |"


def _converged(rows: Sequence[Row]) -> Iterator[str]:
    yield "| log | GNet, preset long: best PSNR | Adam converged | GNet within 0.2 dB after | Adam after | ratio |"
    yield "|---|---|---|---|---|---|"
    for row in rows:
        reached = row["gnet"]["reached_s"]
        gnet = f"{row['gnet']['best_psnr']:.2f} in {row['gnet']['seconds']:.1f} s"
        when = (
            ("never", "")
            if reached is None
            else (f"{reached:.1f} s", f"{enhancement_claims.time_ratio_to_adam(row):.2f}")
        )
        yield f"| {cell_label(row)} | {gnet} | {row['plateau']:.2f} | {when[0]} | {row['adam_s']:.1f} s | {when[1]} |"


def _distillation(rows: Sequence[Row]) -> Iterator[str]:
    yield "| log | from GNet's scene | seconds | kernel at 3 m | PSNR at 3 m | held-out PSNR | ENet's time over its |"
    yield "|---|---|---|---|---|---|---|"
    for row in rows:
        yield f"| {cell_label(row)} | as it is | " + " | ".join(_mark(row["start"])) + " | |"
        for length, mark in row.get("enet_shorter", {}).items():
            yield f"| | ENet, T = {length} | " + " | ".join(_mark(mark)) + " | |"
        yield "| | ENet | " + " | ".join(_mark(row["enet"])) + " | |"
        for family in ("adam", "adam_split", "standard"):
            # A part of the families may have been measured in a cell of its own.
            if (found := row.get(family)) is None:
                continue
            times = (
                f"{enhancement_claims.time_ratio_to_distillation(row, family):.2f}" if found["enet_as_good"] else "no"
            )
            yield f"| | {family}, at its best | " + " | ".join(_mark(found["best"])) + f" | {times} |"
            seconds = found["reached_s"]
            as_enet = found["as_good_as_enet_s"]
            yield f"| | {family}, first as good as that | {seconds:.1f} | | | | |"
            yield f"| | {family}, first as good as ENet | {'never' if as_enet is None else f'{as_enet:.1f}'} | | | | |"


def _mark(mark: Sequence[float | None]) -> tuple[str, ...]:
    seconds, _, kernel, novel_psnr, heldout = mark
    return f"{seconds:.1f}", f"{kernel:.4f}", "" if novel_psnr is None else f"{novel_psnr:.2f}", f"{heldout:.2f}"


def _enhancement(rows: Sequence[Row]) -> Iterator[str]:
    yield "| log | scene | held-out PSNR | " + " | ".join(f"at {s} m" for s in enhancement_claims.SHIFTS) + " |"
    yield "|---|---|---|" + "---|" * len(enhancement_claims.SHIFTS)
    names = {"gnet": "GNet", "enet": "GNet→FNet→ENet", "gnet_again": "GNet→FNet→GNet"}
    for row in rows:
        for scene, name in names.items():
            cells = " | ".join(_at(row["shifts"][s][scene]) for s in enhancement_claims.SHIFTS)
            # The log stands in its first line alone, so that groups of lines are easy to see.
            label = cell_label(row) if scene == "gnet" else ""
            yield f"| {label} | {name} | {row['heldout_psnr'][scene]:.2f} | {cells} |"


def _at(found: Mapping[str, float]) -> str:
    """PSNR and perceptual distance, or kernel distance and the interval of its difference to GNet's."""
    if "kernel" not in found:
        return f"{found['psnr']:.2f} dB, {found['perceptual']:.3f}"
    # GNet's own line has no difference, and so no interval.
    interval = f" ({found['low']:+.4f} to {found['high']:+.4f})" if "low" in found else ""
    return f"{found['kernel']:.4f}{interval}"
