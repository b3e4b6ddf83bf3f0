"""A sweep as a Markdown page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from flows.cost_sweep.summary import COSTS, KERNEL_3M, MEASURES, PSNR, Measure, SettingSummary, Spread

INCLUDED = """Seconds are the wall time of the stages up to the scene, each as it was measured when it was computed:
ingest, plan of effects, initial scene and GNet, and unless the fixer is off novel views, FNet and ENet.
A stage that settings share was computed once.
Left out are evaluation, reading artifacts back, hashing, the start of Python, imports and other first calls.
The process was warm, and had read each log once: a synthetic street is drawn when it is first read.

Seconds, CPU seconds, memory and Gaussians are medians over seeds, all else means.
± is the standard deviation over seeds (order of views, noise of the fixer), pooled over logs."""


def render_page(summaries: Sequence[SettingSummary], novel_measure: Measure, facts: Sequence[str], picture: str) -> str:
    """Writes the page of a sweep.

    Args:
        summaries: the settings.
        novel_measure: what settings are compared by away from the path.
        facts: Markdown lines that say what was measured, on which machine and at which commit.
        picture: path of the picture, relative to the page.

    Returns:
        Markdown: title, facts, picture, a table of accuracy and costs, and a table of seconds by stage.
    """
    head = [
        "# What accuracy costs in time",
        "",
        *facts,
        "",
        INCLUDED,
        "",
        f"![Accuracy against seconds]({picture})",
        "",
    ]
    tables = [render_accuracy(summaries, novel_measure), "Median seconds of each stage:", "", render_seconds(summaries)]
    return "\n".join([*head, *tables])


def render_accuracy(summaries: Sequence[SettingSummary], novel_measure: Measure) -> str:
    """Writes accuracy and costs of a sweep as a table.

    Args:
        summaries: the settings.
        novel_measure: what settings are compared by away from the path.

    Returns:
        Markdown: how to read the table, and a row for each setting.
    """
    return "\n".join([*_accuracy_lines(summaries, novel_measure), ""])


def render_seconds(summaries: Sequence[SettingSummary]) -> str:
    """Writes the seconds of every stage as a table.

    Args:
        summaries: the settings.

    Returns:
        Markdown: a row for each setting.
    """
    return "\n".join([*_seconds_lines(summaries), ""])


def _accuracy_lines(summaries: Sequence[SettingSummary], novel_measure: Measure) -> Iterator[str]:
    # Real logs lack some measures, whose columns would be empty.
    measured = [m for m in MEASURES if any(math.isfinite(x.values[m.name].average) for x in summaries)]
    yield "Gains are over the preset in the same place with the same seed, positive where the setting is better."
    yield f"**Bold**: no setting with as many cells is as good in less time (held-out PSNR, {novel_measure.label})."
    # A table that was read back does not hold the number of images.
    if KERNEL_3M in measured and math.isfinite(summaries[0].images_at_3m):
        # The kernel distance is unbiased, but its variance and the Fréchet distance's bias depend on the set's size.
        count = f"{summaries[0].images_at_3m:.0f}"
        yield f"Distances between sets are of N = {count} images at 3 m; compare them at equal N only."
    yield ""
    labels = " | ".join(m.label for m in (*COSTS, *measured))
    yield f"| knob | value | n | {labels} | gain held out | gain beside |"
    yield "|---" * (5 + len(COSTS) + len(measured)) + "|"
    for x in summaries:
        values = [_format(x.values[m.name], bold=m.name in x.on_front) for m in (*COSTS, *measured)]
        gains = [_format(x.gains[m.name], sign="+") for m in (PSNR, novel_measure)]
        yield f"| {x.knob} | {x.value} | {x.n} | " + " | ".join([*values, *gains]) + " |"


def _seconds_lines(summaries: Sequence[SettingSummary]) -> Iterator[str]:
    names = list(dict.fromkeys(s for x in summaries for s in x.stage_seconds))
    yield "| knob | value | " + " | ".join(names) + " |"
    yield "|---" * (2 + len(names)) + "|"
    for x in summaries:
        seconds = [f"{x.stage_seconds[s]:.2f}" if s in x.stage_seconds else "" for s in names]
        yield f"| {x.knob} | {x.value} | " + " | ".join(seconds) + " |"


def _format(spread: Spread, bold: bool = False, sign: str = "") -> str:
    if math.isnan(spread.average):
        return ""
    # Counts of Gaussians need no decimals; distances, which are below 1, differ in the third.
    digits = 0 if abs(spread.average) >= 100 else 2 if abs(spread.average) >= 1 else 3
    text = f"{spread.average:{sign}.{digits}f}"
    if not math.isnan(spread.sd):
        text += f" ± {spread.sd:.{digits}f}"
    return f"**{text}**" if bold else text
