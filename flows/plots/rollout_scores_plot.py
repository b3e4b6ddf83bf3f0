"""Scores of a rollout as a picture."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from genre_tasks.rollout.rollout_scores import RolloutScores


def plot_rollout_scores(scores: RolloutScores) -> NDArray[np.uint8]:
    """Plots the PSNR of every image with a truth against its log frame, and names the means in the title.

    Args:
        scores: of one rollout; without a truth the plot is empty, and the title has the distances alone.

    Returns:
        An sRGB image [H, W, 3].
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), dpi=110, layout="constrained")
    # The canvas is made by hand: pyplot would keep figures in a global list and may look for a display.
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for camera in dict.fromkeys(view.camera for view in scores.views):
        views = [view for view in scores.views if view.camera == camera and math.isfinite(view.psnr)]
        axes.plot([view.frame for view in views], [view.psnr for view in views], "o", label=camera)
    if scores.views:
        axes.legend(fontsize=8)
    axes.set_title("  ".join(f"{metric.name} {metric.value:.4g}" for metric in scores.metrics), fontsize=9)
    axes.set_xlabel("log frame")
    axes.set_ylabel("PSNR, dB")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
