"""The learning curve of a training: a row for each weight update as Parquet, and a plot of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flows.training.curve_table import LEARNING_CURVE, load_rows, save_rows
from genre_tasks.atomic_path import atomic_path

CURVE_FILE = "curve.parquet"
PLOT_FILE = "curve.png"


def read_curve(folder: Path, before: int) -> list[dict[str, Any]]:
    """Reads the start of a learning curve.

    Args:
        folder: the training's folder.
        before: only updates before the one of this number.

    Returns:
        A dictionary for each update; none where there is no curve.

    Raises:
        ArtifactCorruptError: the table is damaged.
    """
    return [row for row in load_rows(folder / CURVE_FILE, LEARNING_CURVE) if row["step"] < before]


def save_curve(folder: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Writes a learning curve and its plot in place of the old ones.

    Args:
        folder: the training's folder.
        rows: all updates so far.
    """
    save_rows(folder / CURVE_FILE, LEARNING_CURVE, rows)
    plot_curve(rows, folder / PLOT_FILE)


def plot_curve(rows: Sequence[dict[str, Any]], path: Path, window: int = 50) -> None:
    """Plots the held-out loss at each segment's end, and its running mean.

    Args:
        rows: the updates of a learning curve.
        path: the picture to write.
        window: updates in the running mean.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scenes = np.array([row["scene"] for row in rows])
    loss = np.array([row["judged_loss"] for row in rows])
    steps = np.array([row["step"] for row in rows])
    # Over each scene's own mean, so that easy and hard streets can share an axis.
    for name in set(scenes.tolist()):
        loss[scenes == name] /= loss[scenes == name].mean()
    figure = Figure(figsize=(7, 3.5), layout="constrained")
    # Without pyplot, which keeps every figure in memory and may look for a display.
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(steps, loss, ".", markersize=2, alpha=0.4, label="a segment")
    # A shorter curve has no complete window.
    if len(loss) >= window:
        axes.plot(steps[window - 1 :], np.convolve(loss, np.ones(window) / window, "valid"), label=f"mean of {window}")
    minutes = sum(row["seconds"] for row in rows) / 60
    axes.set(xlabel="weight updates", ylabel="loss on unseen views / scene's mean", title=f"{minutes:.1f} minutes")
    axes.legend(loc="upper right")
    # A reader may have the picture open, and a killed training would leave half of it.
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")
