"""Tables and the picture of the page on the paper's image size, from ``genre bench full_size``.

python docs/full_size_tables.py    # draws docs/images/full_size.png
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from docs.result_tables import claims as claims_of  # after the path is set
from docs.result_tables import provenance, result, table
from flows.paper_tables.published_numbers import PAPER

NAME = "full_size"
_STAGE_WORDS = {"gnet": "GNet", "fnet": "FNet", "enet": "ENet"}
_METRICS = {
    "interpolation/psnr": ("held-out PSNR, dB", 2),
    "interpolation/ssim": ("held-out SSIM", 3),
    "interpolation/perceptual": ("held-out perceptual distance", 3),
    "shift_3m/frechet": ("Fréchet distance at 3 m", 3),
    "shift_3m/kernel": ("kernel distance at 3 m", 4),
}


def _rows(kind: str) -> list[dict[str, Any]]:
    return [row for row in result(NAME)["rows"] if row.get("kind") == kind]


def _free_runs() -> list[dict[str, Any]]:
    return [row for row in _rows("run") if row.get("limit_gib") is None]


def claims() -> str:
    """All claims on the paper's size."""
    return claims_of(NAME, several="chunks")


def stages() -> str:
    """Seconds, CPU seconds and memory of every stage, chunk by chunk."""
    lines = []
    for row in _free_runs():
        chunk = f"chunk {row['chunk']}"
        for stage, measured in row["stages"].items():
            numbers = [f"{measured['seconds']:.0f}", f"{measured['cpu_seconds']:.0f}", f"{measured['peak_gib']:.1f}"]
            lines.append([chunk, f"`{stage}`", *numbers])
        cpu_seconds = sum(stage["cpu_seconds"] for stage in row["stages"].values())
        lines.append([chunk, "all", f"{row['seconds']:.0f}", f"{cpu_seconds:.0f}", f"{row['peak_gib']:.1f}"])
    return table(["of PandaSet 002", "stage", "seconds", "CPU seconds", "GiB at most"], lines) + "\n" + provenance(NAME)


def memory() -> str:
    """Memory of every stage, predicted and taken, with and without a limit."""
    lines = []
    for row in _rows("run"):
        limit = "–" if row["limit_gib"] is None else f"{row['limit_gib']:.2f}"
        for stage, measured in row["stages"].items():
            taken, predicted = measured["peak_gib"], measured["predicted_gib"]
            lines.append([limit, f"`{stage}`", f"{predicted:.2f}", f"{taken:.2f}", f"{taken / predicted - 1:+.0%}"])
        lines.append([limit, "all", "", f"{row['peak_gib']:.2f}", ""])
    head = ["limit, GiB", "stage", "predicted, GiB", "taken, GiB", "difference"]
    return table(head, lines) + "\n" + provenance(NAME)


def paper() -> str:
    """The paper's seconds on a GPU beside those on two cores."""
    lines = []
    for row in _free_runs():
        fnet_s = row["stages"]["fnet"]["seconds"] / row["fixed_views"]
        lines.append([f"chunk {row['chunk']}, two cores", f"{row['seconds'] / 60:.1f}", f"{fnet_s:.2f}"])
    minutes = PAPER[5].rows["GenRe+"]["total"]
    lines.append(["the paper, one GPU", str(minutes), str(PAPER[3].rows["Ours (FNet)"]["s_per_frame"])])
    return table(["of", "minutes a chunk", "seconds an image of FNet"], lines) + "\n" + provenance(NAME)


def quality() -> str:
    """What GNet's, FNet's and ENet's images are worth, chunk by chunk."""
    lines = []
    for row in _rows("quality"):
        for stage, name in _STAGE_WORDS.items():
            metrics = row["metrics"][stage]
            # FNet's images are beside the path alone.
            values = [f"{metrics[key]:.{digits}f}" if key in metrics else "–" for key, (_, digits) in _METRICS.items()]
            lines.append([f"chunk {row['chunk']}", name, *values])
    return (
        table(["of PandaSet 002", "images of", *(word for word, _ in _METRICS.values())], lines)
        + "\n"
        + provenance(NAME)
    )


def draw_stages(path: Path) -> None:
    """Draws the share of seconds by stage.

    Args:
        path: the PNG file to write.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = _free_runs()
    figure = Figure(figsize=(8, 0.9 + 0.6 * len(rows)), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    for place, row in enumerate(rows):
        start = 0.0
        for k, (stage, measured) in enumerate(row["stages"].items()):
            axes.barh(place, measured["seconds"], left=start, color=f"C{k}", label=stage if place == 0 else None)
            axes.text(start + measured["seconds"] / 2, place, f"{measured['seconds']:.0f}", ha="center", va="center")
            start += measured["seconds"]
    axes.set_yticks(range(len(rows)), [f"chunk {row['chunk']}" for row in rows])
    axes.invert_yaxis()
    axes.set_xlabel("seconds on two cores")
    figure.legend(ncols=7, loc="outside upper center", fontsize=8)
    FigureCanvasAgg(figure).print_png(str(path))


if __name__ == "__main__":
    draw_stages(ROOT / "docs" / "images" / "full_size.png")
