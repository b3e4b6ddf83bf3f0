"""A sweep as a Markdown page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from flows.cost_sweep.summary import COSTS, KERNEL_3M, MEASURES, PSNR, Line, Measure, Spread

INCLUDED = (
    "Seconds are the wall time of the stages up to the scene (ingest, plan of effects, initial scene, GNet, and unless "
    "it is off novel views, FNet and ENet), each as measured when it was computed; evaluation, reading artifacts back, "
    "hashing, the start of Python, imports and other first calls are not in them (the process was warm, and had read "
    "each log once: a synthetic street is drawn when it is first read). A stage that "
    "settings share was computed once. Seconds, CPU seconds, memory and Gaussians are medians over seeds, all else "
    "means; ± is the standard deviation over seeds (order of views, noise of the fixer), pooled over logs."
)


def page(lines: Sequence[Line], judged: Measure, facts: Sequence[str], picture: str) -> str:
    """Title, facts (what, on which machine, at which commit), picture, a table, and seconds by stage."""
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
    return "\n".join([*head, *_table(lines, judged), "", *_stages(lines), ""])


def _table(lines: Sequence[Line], judged: Measure) -> Iterator[str]:
    shown = [m for m in MEASURES if any(math.isfinite(x.values[m.name].middle) for x in lines)]
    yield "Gains are over the preset in the same place with the same seed, positive where the setting is better. "
    yield f"**Bold**: no setting with as many cells is as good in less time (held-out PSNR, {judged.label})."
    if KERNEL_3M in shown:
        yield f"Distances between sets are of N = {lines[0].images:.0f} images at 3 m; compare them at equal N only."
    yield ""
    yield "| knob | value | n | " + " | ".join(m.label for m in (*COSTS, *shown)) + " | gain held out | gain beside |"
    yield "|---" * (5 + len(COSTS) + len(shown)) + "|"
    for x in lines:
        values = [_value(x.values[m.name], m.name in x.on_front) for m in (*COSTS, *shown)]
        gains = [_value(x.gains[m.name], sign="+") for m in (PSNR, judged)]
        yield f"| {x.knob} | {x.value} | {x.n} | " + " | ".join([*values, *gains]) + " |"


def _stages(lines: Sequence[Line]) -> Iterator[str]:
    names = list(dict.fromkeys(s for x in lines for s in x.stage_seconds))
    yield "Median seconds by stage:"
    yield ""
    yield "| knob | value | " + " | ".join(names) + " |"
    yield "|---" * (2 + len(names)) + "|"
    for x in lines:
        cells = [f"{x.stage_seconds[s]:.2f}" if s in x.stage_seconds else "" for s in names]
        yield f"| {x.knob} | {x.value} | " + " | ".join(cells) + " |"


def _value(spread: Spread, bold: bool = False, sign: str = "") -> str:
    if math.isnan(spread.middle):
        return ""
    digits = 0 if abs(spread.middle) >= 100 else 2 if abs(spread.middle) >= 1 else 3
    text = f"{spread.middle:{sign}.{digits}f}" + ("" if math.isnan(spread.sd) else f" ± {spread.sd:.{digits}f}")
    return f"**{text}**" if bold else text
