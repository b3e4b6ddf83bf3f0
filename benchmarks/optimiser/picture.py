"""Curves of held-out PSNR over seconds, from a written result.

python -m benchmarks.optimiser.picture docs/benchmarks/optimiser.json docs/benchmarks/optimiser.png
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.bench import Row
from benchmarks.optimiser.summary import place


def draw(rows: Sequence[Row], picture: Path) -> None:
    """A panel for each log and order; seconds on a logarithmic axis. Raises ``ValueError`` without a measured race."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullFormatter

    panels: dict[str, list[Row]] = {}
    for row in rows:
        if "variants" in row:
            panels.setdefault(place(row), []).append(row)
    if not panels:
        raise ValueError("expected at least one measured race; the result has none")
    figure, axes = plt.subplots(1, len(panels), figsize=(4.2 * len(panels), 3.6), layout="constrained", squeeze=False)
    for axis, (title, races) in zip(axes[0], panels.items(), strict=True):
        for i, row in enumerate(races):
            _curve(axis, "GNet" if i == 0 else None, row["gnet"], color="black", marker="o", markersize=3)
            for name, variant in row["variants"].items():
                _curve(axis, f"{row['method']} {name}", variant, linewidth=1)
        axis.set(title=title, xscale="log", xlabel="seconds", ylabel="held-out PSNR, dB")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(alpha=0.3)
        axis.legend(fontsize=6)
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def _curve(axis: Any, label: str | None, row: Mapping[str, Any], **style: Any) -> None:
    seconds, psnr = ([point[k] for point in row["curve"][1:]] for k in (0, 2))  # the start is at no second
    axis.plot(seconds, psnr, label=label, **style)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    draw(json.loads(options.result.read_text(encoding="utf-8"))["rows"], options.picture)


if __name__ == "__main__":
    main()
