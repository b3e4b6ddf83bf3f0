"""The learning curve of a training: a row for each weight update as Parquet, and a picture of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flows.training.curve_table import LEARNING, read_rows, write_rows

CURVE, PICTURE = "curve.parquet", "curve.png"


def read_curve(folder: Path, before: int) -> list[dict[str, Any]]:
    """The rows of the updates before the one numbered ``before``; none where there is no curve."""
    return [row for row in read_rows(folder / CURVE, LEARNING) if row["step"] < before]


def write_curve(folder: Path, rows: Sequence[dict[str, Any]]) -> None:
    """``curve.parquet`` and ``curve.png``."""
    write_rows(folder / CURVE, LEARNING, rows)
    plot_curve(rows, folder / PICTURE)


def plot_curve(rows: Sequence[dict[str, Any]], picture: Path, window: int = 50) -> None:
    """The unseen views' loss at each segment's end over its scene's mean, its running mean, and wall time.

    Each scene's losses are divided by that scene's mean, so that easy and hard streets can share an axis.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scenes = np.array([row["scene"] for row in rows])
    loss = np.array([row["judged_loss"] for row in rows])
    steps = np.array([row["step"] for row in rows])
    for name in set(scenes.tolist()):
        loss[scenes == name] /= loss[scenes == name].mean()
    figure = Figure(figsize=(7, 3.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(steps, loss, ".", markersize=2, alpha=0.4, label="a segment")
    if len(loss) >= window:
        axes.plot(steps[window - 1 :], np.convolve(loss, np.ones(window) / window, "valid"), label=f"mean of {window}")
    minutes = sum(row["seconds"] for row in rows) / 60
    axes.set(xlabel="weight updates", ylabel="loss on unseen views / scene's mean", title=f"{minutes:.1f} minutes")
    axes.legend(loc="upper right")
    temporary = picture.with_name(f".{picture.name}")
    figure.savefig(temporary, dpi=120, format="png")
    temporary.replace(picture)
