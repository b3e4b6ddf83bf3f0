"""Accuracy against seconds as a picture: a panel for each knob, over what no setting of the whole sweep beats."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flows.cost_sweep.knobs import EFFECTS, PRESET_ITSELF, TOGETHER
from flows.cost_sweep.summary import PSNR, Line, Measure

LABELLED = 0.005
"""Effects that change a measure by less of the preset's get no label: a dozen lie on one point."""
COLUMNS = 5


def drawn(lines: Sequence[Line], judged: Measure, title: str) -> NDArray[np.uint8]:
    """[H, W, 3]: for each knob two panels, held-out PSNR over what is ``judged`` beside the path; up is better."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    knobs = list(dict.fromkeys(x.knob for x in lines if x.knob != PRESET_ITSELF))
    columns = min(COLUMNS, max(1, len(knobs)))
    rows = -(-max(1, len(knobs)) // columns)
    figure = Figure(figsize=(3.6 * columns, 5.0 * rows), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(2 * rows, columns, squeeze=False)
    for axes in panels.ravel():
        axes.set_visible(False)
    for k, knob in enumerate(knobs):
        for below, measure in enumerate((PSNR, judged)):
            axes = panels[2 * (k // columns) + below, k % columns]
            axes.set_visible(True)
            _panel(axes, lines, knob, measure)
            axes.set_ylabel(measure.label if k % columns == 0 else "", fontsize=8)
            axes.set_title("" if below else knob.replace("_", " "), fontsize=9)
            axes.set_xlabel("seconds, without evaluation" if below else "", fontsize=8)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    figure.suptitle(textwrap.fill(title, 50 * columns), fontsize=9)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _panel(axes, lines: Sequence[Line], knob: str, measure: Measure) -> None:  # type: ignore[no-untyped-def]  # matplotlib's axes
    preset = next(x for x in lines if x.knob == PRESET_ITSELF)
    star = preset.values[measure.name].middle
    best = sorted((x for x in lines if measure.name in x.on_front), key=lambda x: x.seconds)
    x, y, _ = _points(best, measure)
    axes.step(
        x, y, where="post", color="0.6", linewidth=1, label="no setting with as many cells is better in less time"
    )
    own = sorted((x for x in lines if x.knob == knob), key=lambda x: x.seconds)
    x, y, e = _points(own, measure)
    axes.errorbar(x, y, e, fmt="o", color="C0", markersize=4, linewidth=1, label="a setting, ± over seeds")
    for at_x, at_y, line in zip(x, y, own, strict=True):
        if knob == EFFECTS and abs(line.gains[measure.name].middle) < LABELLED * abs(star):
            continue
        if knob == TOGETHER and measure.name not in line.on_front:
            continue
        axes.annotate(line.value, (at_x, at_y), fontsize=7, xytext=(4, 3), textcoords="offset points")
    axes.plot([preset.seconds], [star], "*", color="black", markersize=11, label="preset")
    axes.set_xlim(*_around([*x, preset.seconds], 4.0))
    axes.set_ylim(*_around([*y, star], 0.02 * abs(star)))
    if not measure.more_is_better:
        axes.invert_yaxis()
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.3)


def _around(values: Sequence[float], least: float) -> tuple[float, float]:
    """Limits of an axis that has these values and is at least so wide; some space is left for labels."""
    known = [v for v in values if math.isfinite(v)]
    low, high = min(known), max(known)
    wider = max(0.0, least - (high - low)) / 2
    margin = 0.15 * (high - low + 2 * wider)
    return low - wider - margin, high + wider + 1.5 * margin


def _points(lines: Sequence[Line], measure: Measure) -> tuple[list[float], list[float], list[float]]:
    spreads = [x.values[measure.name] for x in lines]
    return [x.seconds for x in lines], [s.middle for s in spreads], [0 if math.isnan(s.sd) else s.sd for s in spreads]
