"""A plan of effects as a picture."""

from __future__ import annotations

import math
import textwrap

import numpy as np
from numpy.typing import NDArray

from genre_tasks.effects.types import EffectsPlan

_LEAST = 0.01
"""Where the logarithmic axis begins, in thresholds."""
_TITLE_CHARACTERS = 95
_MOST = 1000.0
"""Where bars end at the latest: LiDAR's usual density is far above the least that is of use."""


def plot_effects_plan(plan: EffectsPlan, title: str = "") -> NDArray[np.uint8]:
    """Draws a bar for each effect: its measured value in thresholds, red where the effect is modelled.

    Args:
        plan: the plan, with a decision for every effect.
        title: written above the plot.

    Returns:
        An sRGB image [H, W, 3].
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Horizontal bars count from the bottom; the first effect belongs on top.
    decisions = plan.decisions[::-1]
    figure = Figure(figsize=(8, 0.36 * len(decisions) + 1.2), dpi=120, layout="constrained")
    # The canvas is made by hand: pyplot would keep figures in a global list and may look for a display.
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    measured = [not math.isnan(d.value) and d.threshold > 0 for d in decisions]
    in_thresholds = [
        min(max(d.value / d.threshold, _LEAST), _MOST) if is_measured else _LEAST
        for d, is_measured in zip(decisions, measured, strict=True)
    ]
    widths = [value - _LEAST for value in in_thresholds]
    colors = ["tab:grey" if d.choice == "off" else "tab:red" for d in decisions]
    axes.barh(range(len(decisions)), widths, left=_LEAST, color=colors)
    axes.axvline(1, color="black", linewidth=1)
    # The axis ends well to the right of the longest bar, so that the text beside it fits.
    axes.set(xscale="log", xlim=(_LEAST, max(*in_thresholds, 10.0) * 30))
    # Over the figure and in lines: the address of a log is often wider than the axes.
    figure.suptitle(textwrap.fill(title, _TITLE_CHARACTERS), fontsize=9)
    axes.set_xlabel("value / threshold: right of the line it is called for")
    axes.set_yticks(range(len(decisions)), [d.name.replace("_", " ") for d in decisions])
    for row, d in enumerate(decisions):
        explanation = f"{d.value:.3g} {d.unit}" if measured[row] else d.reason
        label = f"{d.choice}: {explanation}"
        axes.text(in_thresholds[row] * 1.2, row, label, va="center", fontsize=7, backgroundcolor="white")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
