"""The optimiser's rows as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from benchmarks.bench import Row
from benchmarks.optimiser.summary import place


def markdown(rows: Mapping[str, Row]) -> Iterator[str]:
    """A line for each race and variant, GNet before each race; the network; stability; what was not measured."""
    yield "| log | method | seconds | renders | best PSNR | at equal renders | reached GNet's PSNR after | × GNet |"
    yield "|---|---|---|---|---|---|---|---|"
    for row in (r for r in rows.values() if "variants" in r):
        yield from _race(row)
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
    for name, row in rows.items():
        if "ratio" in row:
            losses = ", ".join(f"{k} T: {v:.5f}" for k, v in row["loss"].items())
            yield f"\n{place(row)}, past its length: loss at {losses}; 10 T over T {row['ratio']:.4f}"
        if "not_measured" in row:
            yield f"\n{name}: not measured: {row['not_measured']}"


def _race(row: Row) -> Iterator[str]:
    g = row["gnet"]
    yield f"| {place(row)} | GNet | {g['seconds']:.1f} | {g['renders']} | {g['psnr']:.2f} | | | 1 |"
    for name, v in row["variants"].items():
        equal = v["psnr_at_equal_renders"]
        if v["reached_s"] is None:
            when, times = f"never ({v['ended']})", f"≥ {row['cap']:g}" if v["ended"] == "cap" else ""
        else:
            when, times = f"{v['reached_s']:.1f} s", f"{v['reached_s'] / g['seconds']:.2f}"
        cells = (f"{v['ended_s']:.1f}", v["renders"], f"{v['best_psnr']:.2f}", "" if equal is None else f"{equal:.2f}")
        yield f"| | {row['method']} {name} | " + " | ".join(map(str, cells)) + f" | {when} | {times} |"
