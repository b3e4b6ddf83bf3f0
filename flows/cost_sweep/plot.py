"""Accuracy against seconds as a picture: a panel for each knob, over what no setting of the whole sweep beats."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flows.cost_sweep.knobs import EFFECTS, MORE_GAUSSIANS, PRESET_ITSELF, TOGETHER
from flows.cost_sweep.summary import PSNR, Measure, SettingSummary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.transforms import Bbox

LABELLED_CHANGE = 0.005
"""Effects that change a measure by less than this fraction of the preset's get no label: a dozen lie on one point."""
LEAST_WIDTH_S = 4.0
LEAST_HEIGHT = 0.02
"""Height of a panel's range at least, as a fraction of the preset's value."""
LABEL_WIDTH = 22
"""Characters of a label's line at most: a panel is some sixty wide."""
COLUMNS = 5


def draw_sweep(summaries: Sequence[SettingSummary], novel_measure: Measure, title: str) -> NDArray[np.uint8]:
    """Draws a sweep.

    Args:
        summaries: the settings; the preset among them gets a star.
        novel_measure: what settings are compared by away from the path.
        title: wrapped to the picture's width.

    Returns:
        [H, W, 3] sRGB: for each knob two panels, held-out PSNR over ``novel_measure``; up is better in both.
    """
    # Imported here, because the command line should start without matplotlib.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    knobs = list(dict.fromkeys(x.knob for x in summaries if x.knob != PRESET_ITSELF))
    rows = math.ceil(max(1, len(knobs)) / COLUMNS)
    # As many in each row, as far as they go: a last row of one panel would leave the others' space empty.
    columns = math.ceil(max(1, len(knobs)) / rows)
    figure = Figure(figsize=(3.6 * columns, 5.0 * rows), dpi=100, layout="constrained")
    # A canvas of its own and not pyplot, whose global state would leak between threads and need a display.
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(2 * rows, columns, squeeze=False)
    # The last row of the grid may have panels without a knob.
    for axes in panels.ravel():
        axes.set_visible(False)
    for k, knob in enumerate(knobs):
        row, column = divmod(k, columns)
        for lower, measure in enumerate((PSNR, novel_measure)):
            axes = panels[2 * row + lower, column]
            axes.set_visible(True)
            _draw_panel(axes, summaries, knob, measure)
            axes.set_ylabel(measure.label if column == 0 else "", fontsize=8)
            axes.set_title("" if lower else knob.replace("_", " "), fontsize=9)
            axes.set_xlabel("seconds, without evaluation" if lower else "", fontsize=8)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    figure.suptitle(textwrap.fill(title, 50 * columns), fontsize=9)
    # Where labels stand is known once the panels have their size.
    canvas.draw()
    for axes in panels.ravel():
        _move_labels_inside(axes)
        _remove_hidden_labels(axes)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_panel(axes: Axes, summaries: Sequence[SettingSummary], knob: str, measure: Measure) -> None:
    # A sweep whose preset failed has none.
    preset = next((x for x in summaries if x.knob == PRESET_ITSELF), None)
    star = () if preset is None else ((preset.seconds, preset.values[measure.name].average),)
    # The front is that of the whole sweep, so that a panel shows what other knobs reach in the same time.
    front = sorted((x for x in summaries if measure.name in x.on_front), key=lambda x: x.seconds)
    seconds, values, _ = _points(front, measure)
    label = "no setting with as many cells is better in less time"
    # Steps and not lines: nothing was measured between two settings.
    axes.step(seconds, values, where="post", color="0.6", linewidth=1, label=label)
    turned = sorted((x for x in summaries if x.knob == knob), key=lambda x: x.seconds)
    seconds, values, errors = _points(turned, measure)
    axes.errorbar(
        seconds, values, errors, fmt="o", color="C0", markersize=4, linewidth=1, label="a setting, ± over seeds"
    )
    for x, y in star:
        axes.plot([x], [y], "*", color="black", markersize=11, label="preset")
    reference = star[0][1] if star else values[0]
    axes.set_xlim(*_limits([*seconds, *(x for x, _ in star)], LEAST_WIDTH_S))
    axes.set_ylim(*_limits([*values, *(y for _, y in star)], LEAST_HEIGHT * abs(reference)))
    for x, y, summary in zip(seconds, values, turned, strict=True):
        if _is_labelled(summary, measure, reference):
            # Towards the middle of the panel, as long names would leave it.
            is_right = x > sum(axes.get_xlim()) / 2
            place = {"xytext": (-4, 3), "ha": "right"} if is_right else {"xytext": (4, 3)}
            text = textwrap.fill(summary.value, LABEL_WIDTH)
            axes.annotate(text, (x, y), fontsize=7, textcoords="offset points", **place)
    # Up has to mean better in every panel, also for distances.
    if not measure.more_is_better:
        axes.invert_yaxis()
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.3)


def _move_labels_inside(axes: Axes) -> None:
    """Moves labels that leave the panel back to its border: beside it they would be taken for another panel's."""
    figure = axes.get_figure(root=True)
    # Every panel has one; only a type checker does not know.
    assert figure is not None
    points_per_px = 72.0 / figure.dpi
    panel = axes.bbox
    for label in axes.texts:
        box = label.get_window_extent()
        right_px = max(0.0, panel.x0 - box.x0) - max(0.0, box.x1 - panel.x1)
        up_px = max(0.0, panel.y0 - box.y0) - max(0.0, box.y1 - panel.y1)
        x, y = label.get_position()
        label.set_position((x + points_per_px * right_px, y + points_per_px * up_px))


def _remove_hidden_labels(axes: Axes) -> None:
    """Removes labels that would lie on an earlier one: settings that change nothing share one point."""
    shown: list[Bbox] = []
    for label in list(axes.texts):
        box = label.get_window_extent()
        if any(box.overlaps(other) for other in shown):
            label.remove()
        else:
            shown.append(box)


def _is_labelled(summary: SettingSummary, measure: Measure, reference: float) -> bool:
    if summary.knob == EFFECTS:
        # Written with "not", so that an unknown gain, which is NaN, gets its label.
        return not abs(summary.gains[measure.name].average) < LABELLED_CHANGE * abs(reference)
    # Two dozen combinations would hide each other's labels: only the best ones are named.
    return summary.knob not in (TOGETHER, MORE_GAUSSIANS) or measure.name in summary.on_front


def _limits(values: Sequence[float], least: float) -> tuple[float, float]:
    """Gives limits of an axis that hold these values, are at least ``least`` apart, and leave space for labels."""
    # A NaN among the values would make both limits NaN, and the panel empty.
    known = [v for v in values if math.isfinite(v)]
    # A log without held-out images has no such value at all.
    if not known:
        return 0.0, 1.0
    low = min(known)
    high = max(known)
    # Without a least range, noise of a hundredth of a second would fill the panel.
    wider = max(0.0, least - (high - low)) / 2
    margin = 0.15 * (high - low + 2 * wider)
    # Labels stand to the upper right of their points, so that margin is the larger one.
    return low - wider - margin, high + wider + 1.5 * margin


def _points(summaries: Sequence[SettingSummary], measure: Measure) -> tuple[list[float], list[float], list[float]]:
    """Gives seconds, averages and error bars; a single seed has no error bar."""
    seconds = [x.seconds for x in summaries]
    spreads = [x.values[measure.name] for x in summaries]
    return seconds, [s.average for s in spreads], [0 if math.isnan(s.sd) else s.sd for s in spreads]
