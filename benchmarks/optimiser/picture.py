"""Pictures from a written result: curves of PSNR over seconds, and the network's time over the number of Gaussians.

python -m benchmarks.optimiser.picture docs/benchmarks/optimiser.json docs/benchmarks/optimiser.png \
    --network docs/benchmarks/optimiser_network.png
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.bench import Row
from benchmarks.optimiser.cells import place

HELDOUT, BESIDE = 2, 4
"""Columns of a curve's points; the latter only where there is truth beside the path."""


def draw(rows: Sequence[Row], picture: Path) -> None:
    """A column for each log, its first order: held-out PSNR, and below it PSNR at 3 m where the log has truth.

    Seconds on a logarithmic axis. Raises ``ValueError`` without a measured race.
    """
    panels = _first_orders([row for row in rows if "variants" in row])
    if not panels:
        raise ValueError("expected at least one measured race; the result has none")
    columns = [HELDOUT, BESIDE] if any(len(r[0]["gnet"]["curve"][0]) > BESIDE for r in panels.values()) else [HELDOUT]
    plt = _pyplot()
    size = (4.2 * len(panels), 3.6 * len(columns))
    figure, axes = plt.subplots(len(columns), len(panels), figsize=size, layout="constrained", squeeze=False)
    for k, column in enumerate(columns):
        for axis, (title, races) in zip(axes[k], panels.items(), strict=True):
            _panel(axis, title, races, column)
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def draw_network(row: Row, picture: Path) -> None:
    """Seconds of an evaluation over the number of Gaussians with the fitted line, and the memory that it adds."""
    plt = _pyplot()
    counts = [int(name) for name in row["seconds"]]
    medians, low, high = ([m[k] for m in row["seconds"].values()] for k in ("median", "low", "high"))
    below, above = ([abs(a - b) for a, b in zip(medians, ends, strict=True)] for ends in (low, high))
    fit = row["fit"]
    figure, axis = plt.subplots(figsize=(5.5, 3.6), layout="constrained")
    axis.errorbar(counts, medians, (below, above), fmt="o", capsize=3, label="median and quartiles")
    line = [fit["seconds"] + fit["us_per_gaussian"] * 1e-6 * n for n in counts]
    axis.plot(counts, line, linewidth=1, label=f"{fit['us_per_gaussian']:.2f} µs a Gaussian, R² {fit['r2']:.4f}")
    axis.set(xlabel="Gaussians", ylabel="seconds of an evaluation", ylim=(0, None))
    memory = axis.twinx()
    memory.plot(counts, list(row["peak_mib"].values()), "s--", color="grey", markersize=4, label="memory added, MiB")
    memory.set(ylabel="MiB", ylim=(0, None))
    axis.set_xticks(counts, [f"{n // 1000}k" for n in counts], fontsize=7)
    axis.grid(alpha=0.3)
    axis.legend(loc="upper left", fontsize=8)
    memory.legend(loc="lower right", fontsize=8)
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def _first_orders(races: Sequence[Row]) -> dict[str, list[Row]]:
    """The races of each log's lowest order, by their title."""
    first: dict[tuple[str, int], int] = {}
    for row in races:
        where = (row["log"], row["chunk"])
        first[where] = min(row["order"], first.get(where, row["order"]))
    panels: dict[str, list[Row]] = {}
    for row in races:
        if row["order"] == first[row["log"], row["chunk"]]:
            panels.setdefault(place(row), []).append(row)
    return panels


def _panel(axis: Any, title: str, races: Sequence[Row], column: int) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    if len(races[0]["gnet"]["curve"][0]) <= column:
        axis.set_axis_off()
        return
    for i, row in enumerate(races):
        _curve(axis, "GNet" if i == 0 else None, row["gnet"], column, color="black", marker="o", markersize=3)
        for name, variant in row["variants"].items():
            _curve(axis, f"{row['method']} {name}", variant, column, linewidth=1)
    label = "held-out PSNR, dB" if column == HELDOUT else "PSNR at 3 m, dB"
    axis.set(title=title, xscale="log", xlabel="seconds", ylabel=label)
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.3)
    axis.legend(fontsize=6)


def _curve(axis: Any, label: str | None, row: Mapping[str, Any], column: int, **style: Any) -> None:
    seconds, psnr = ([point[k] for point in row["curve"][1:]] for k in (0, column))  # the start is at no second
    axis.plot(seconds, psnr, label=label, **style)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--network", type=Path, help="the second picture")
    options = parser.parse_args()
    rows = json.loads(options.result.read_text(encoding="utf-8"))["rows"]
    draw(rows, options.picture)
    if options.network:
        draw_network(next(row for row in rows if row["cell"] == "network"), options.network)


if __name__ == "__main__":
    main()
