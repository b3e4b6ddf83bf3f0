"""Accuracy against seconds as a picture: a line for each knob, the preset as a star, and the front."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flows.cost.knobs import EFFECTS, PRESET_ITSELF, TOGETHER
from flows.cost.summary import PSNR, Line, Measure

LABELLED = 0.005
"""Effects that change a measure by less of the preset's get no label: a dozen lie on one point."""


def drawn(lines: Sequence[Line], judged: Measure, title: str) -> NDArray[np.uint8]:
    """[H, W, 3]: held-out PSNR on the left, what is ``judged`` beside the path on the right; up is better in both."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 6), dpi=110, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2)
    for axes, measure in zip(panels, (PSNR, judged), strict=True):
        _panel(axes, lines, measure)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=8)
    figure.suptitle(title, fontsize=9)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _panel(axes, lines: Sequence[Line], measure: Measure) -> None:  # type: ignore[no-untyped-def]  # matplotlib's axes
    preset = next(x for x in lines if x.knob == PRESET_ITSELF)
    star = preset.values[measure.name].mean
    knobs = list(dict.fromkeys(x.knob for x in lines if x.knob != PRESET_ITSELF))
    for k, knob in enumerate(knobs):
        own = sorted((x for x in lines if x.knob == knob), key=lambda x: x.seconds)
        x, y, e = _points(own, measure)
        style = "" if knob in (TOGETHER, EFFECTS) else "-"
        axes.errorbar(x, y, e, fmt=f"{style}o", color=f"C{k % 10}", markersize=4, linewidth=1, label=knob)
        for at_x, at_y, line in zip(x, y, own, strict=True):
            if knob == EFFECTS and abs(line.gains[measure.name].mean) < LABELLED * abs(star):
                continue
            axes.annotate(line.value, (at_x, at_y), fontsize=6, xytext=(3, 3), textcoords="offset points")
    best = sorted((x for x in lines if measure.name in x.on_front), key=lambda x: x.seconds)
    x, y, _ = _points(best, measure)
    axes.step(
        x, y, where="post", color="black", linewidth=0.8, linestyle=":", label="no setting is better in less time"
    )
    axes.plot([preset.seconds], [star], "*", color="black", markersize=14, label="preset")
    axes.set(xscale="log", xlabel="seconds of all stages, without evaluation", ylabel=measure.label)
    if not measure.more_is_better:
        axes.invert_yaxis()
    axes.grid(alpha=0.3)


def _points(lines: Sequence[Line], measure: Measure) -> tuple[list[float], list[float], list[float]]:
    spreads = [x.values[measure.name] for x in lines]
    return [x.seconds for x in lines], [s.mean for s in spreads], [0 if math.isnan(s.sd) else s.sd for s in spreads]
