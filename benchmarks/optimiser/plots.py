"""Pictures from a written result: curves of PSNR over seconds, and the network's time over the number of Gaussians.

python -m benchmarks.optimiser.plots docs/results/data/optimiser.json docs/images/optimiser.png \
    --network docs/images/optimiser_network.png
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from benchmarks.common.bench import Row
from benchmarks.common.context import cell_label

ACROSS = 3
"""Panels in a row."""
LABELS = {
    "tuned_adam": "tuned Adam",
    "tuned_adam_split": "tuned Adam on split Gaussians",
    "standard_3dgs": "standard 3DGS",
    "street_gs": "Street Gaussians' recipe",
}
COLOURS = {
    "tuned_adam": "tab:blue",
    "tuned_adam_split": "tab:green",
    "standard_3dgs": "tab:red",
    "street_gs": "tab:orange",
}
COLOURS_OF_A_PICTURE = 64
HELDOUT = 2
NOVEL = 4
"""Columns of a curve's points; the latter only where there is truth at novel views."""


def draw(rows: Sequence[Row], picture: Path) -> None:
    """Draws the first order of each log: held-out PSNR, and below it PSNR at 3 m where the log has truth.

    Each method's variants are thin lines, the best that any of them has had by then a bold one. Seconds, logarithmic,
    are in GNet's of the same cell, so that cells of other machines or threads can share a panel; the first cell's stand
    in its title.

    Args:
        rows: of the optimiser's benchmark.
        picture: file to write.

    Raises:
        ValueError: no race was measured.
    """
    panels = _first_orders([row for row in rows if "variants" in row])
    if not panels:
        raise ValueError("expected at least one measured race; the result has none")
    wide = min(ACROSS, len(panels))
    # Logs fill rows of panels; each block of logs has a row for each kind of PSNR.
    blocks = [list(panels.items())[k : k + wide] for k in range(0, len(panels), wide)]
    lines = [(block, column) for block in blocks for column in (HELDOUT, NOVEL) if _has(block, column)]
    plt = _pyplot()
    size = (4.6 * wide, 3.2 * len(lines) + 0.4)
    figure, axes = plt.subplots(len(lines), wide, figsize=size, layout="constrained", squeeze=False)
    for row_of_axes, (block, column) in zip(axes, lines, strict=True):
        for axis, panel in itertools.zip_longest(row_of_axes, block):
            if panel is None or not _has([panel], column):
                axis.set_axis_off()
            else:
                _panel(axis, panel[0], panel[1], column)
    # Panels share methods: one legend for the figure has each of them once.
    known = {label: line for axis in axes.flat for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(known.values(), known.keys(), loc="outside lower center", ncols=len(known), fontsize=9)
    _save(figure, picture, dpi=90)
    plt.close(figure)


def envelope(curves: Sequence[Sequence[Sequence[float]]], column: int) -> tuple[list[float], list[float]]:
    """Finds the best that any of several curves has had by each time.

    Args:
        curves: points of seconds and other columns; the first point, the start, does not count.
        column: that is compared.

    Returns:
        Seconds, and the best value by then.

    >>> envelope([[[0, 9], [1, 5], [3, 4]], [[0, 9], [2, 6]]], 1)
    ([1, 2, 3], [5, 6, 6])
    """
    best = -float("inf")
    seconds = []
    values = []
    for point in sorted((p for curve in curves for p in curve[1:]), key=lambda p: p[0]):
        # A user would stop at the best scene so far, so a curve that falls again is not held against a method.
        best = max(best, point[column])
        seconds.append(point[0])
        values.append(best)
    return seconds, values


def draw_network(row: Row, picture: Path) -> None:
    """Draws seconds of an evaluation over the number of Gaussians with the fitted line, and the memory that it adds.

    Args:
        row: of the cell of the network.
        picture: file to write.
    """
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
    # Memory has an axis of its own: its numbers are thousands of times those of seconds.
    memory = axis.twinx()
    memory.plot(counts, list(row["peak_mib"].values()), "s--", color="grey", markersize=4, label="memory added, MiB")
    memory.set(ylabel="MiB", ylim=(0, None))
    axis.set_xticks(counts, [f"{n // 1000}k" for n in counts], fontsize=7)
    axis.grid(alpha=0.3)
    axis.legend(loc="upper left", fontsize=8)
    memory.legend(loc="lower right", fontsize=8)
    _save(figure, picture, dpi=110)
    plt.close(figure)


def _save(figure: Any, picture: Path, dpi: int) -> None:
    figure.savefig(picture, dpi=dpi)
    # Lines need few colours, and the file is a third as large with a palette.
    with Image.open(picture) as drawn:
        drawn.convert("RGB").quantize(COLOURS_OF_A_PICTURE, dither=Image.Dither.NONE).save(picture, optimize=True)


def _pyplot() -> Any:
    # The backend must be chosen before pyplot is imported; a machine without a display has no other.
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def _first_orders(races: Sequence[Row]) -> dict[str, list[Row]]:
    """The races of each log's lowest order, by their title."""
    first: dict[tuple[str, int], int] = {}
    for row in races:
        where = (row["log"], row["chunk"])
        # One order a panel: curves of several would cover each other.
        first[where] = min(row["order"], first.get(where, row["order"]))
    panels: dict[str, list[Row]] = {}
    for row in races:
        if row["order"] == first[row["log"], row["chunk"]]:
            panels.setdefault(cell_label(row), []).append(row)
    return panels


def _has(panels: Sequence[tuple[str, list[Row]]], column: int) -> bool:
    return any(len(races[0]["gnet"]["curve"][0]) > column for _, races in panels)


def _panel(axis: Any, title: str, races: Sequence[Row], column: int) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    for row in races:
        unit = row["gnet"]["seconds"]
        colour = COLOURS[row["method"]]
        curves = [[[p[0] / unit, *p[1:]] for p in v["curve"]] for v in row["variants"].values()]
        for curve in curves:
            axis.plot(
                [p[0] for p in curve[1:]], [p[column] for p in curve[1:]], color=colour, linewidth=0.6, alpha=0.45
            )
        axis.plot(*envelope(curves, column), color=colour, linewidth=1.8, label=LABELS[row["method"]])
    gnet = races[0]["gnet"]
    # The start is at second 0, which a logarithmic axis cannot show.
    points = [(p[0] / gnet["seconds"], p[column]) for p in gnet["curve"][1:]]
    axis.plot(*zip(*points, strict=True), color="black", marker="o", markersize=3, label="GNet")
    label = "held-out PSNR, dB" if column == HELDOUT else "PSNR at 3 m, dB"
    threads = f", {n} threads" if (n := races[0].get("threads", 2)) > 1 else ", 1 thread"
    title = f"{title.partition(' order')[0]} (GNet: {gnet['seconds']:.1f} s{threads})"
    axis.set_title(title, fontsize=9)
    axis.set(xscale="log", xlabel="seconds ÷ GNet's seconds", ylabel=label)
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.3)


def main() -> None:
    """Draws the pictures that the command line names."""
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
