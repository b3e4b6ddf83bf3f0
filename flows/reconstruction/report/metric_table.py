"""The numbers of a chunk's report: the headline, and the table of metrics over the stages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from flows.reconstruction.run_summary import ChunkSummary, StageSummary

SCORED_STAGES = ("initial", "gnet", "fnet", "enet")
"""Columns of the table of metrics."""


@dataclass(frozen=True)
class MetricFormat:
    """How a metric is shown.

    Attributes:
        label: its name for readers.
        higher_is_better: whether a larger value is better.
        decimals: digits after the point.
    """

    label: str
    higher_is_better: bool
    decimals: int


METRIC_FORMATS = {
    "psnr": MetricFormat("PSNR, dB", higher_is_better=True, decimals=2),
    "cc_psnr": MetricFormat("PSNR, colours fitted, dB", higher_is_better=True, decimals=2),
    "ssim": MetricFormat("SSIM", higher_is_better=True, decimals=4),
    "perceptual": MetricFormat("Perceptual", higher_is_better=False, decimals=4),
    "lpips_alex": MetricFormat("LPIPS, AlexNet", higher_is_better=False, decimals=4),
    "lpips_vgg": MetricFormat("LPIPS, VGG16", higher_is_better=False, decimals=4),
    "lpips": MetricFormat("LPIPS, network of a file", higher_is_better=False, decimals=4),
    "kernel": MetricFormat("Kernel", higher_is_better=False, decimals=4),
    "frechet": MetricFormat("Fréchet", higher_is_better=False, decimals=3),
}


@dataclass(frozen=True)
class MetricValue:
    """A value in the table of metrics.

    Attributes:
        text: the number as it is shown.
        interval: its 95 % interval; empty without one.
        best: whether it is the best of its row.
    """

    text: str
    interval: str = ""
    best: bool = False


@dataclass(frozen=True)
class MetricRow:
    """One metric over the stages.

    Attributes:
        label: the metric's name for readers.
        arrow: the direction that is better, as an arrow; empty for a count.
        values: one for each of :data:`SCORED_STAGES`; ``None`` where the stage was not scored.
        group: the heading above the row; empty for all rows of a group but the first.
        size: number of rows in the group, given with its first row.
    """

    label: str
    arrow: str
    values: tuple[MetricValue | None, ...]
    group: str = ""
    size: int = 1


def build_headline(chunk: ChunkSummary) -> list[tuple[str, str, str]]:
    """Picks the few numbers that a reader wants first.

    Args:
        chunk: the chunk's summary.

    Returns:
        (label, value, comparison with an earlier stage) of each number that was measured.

    >>> stages = [StageSummary("gnet", "5f41", False, 4.0, 900.0, {"interpolation/psnr": 24.0})]
    >>> build_headline(ChunkSummary(0, tuple(stages)))
    [('Held-out PSNR after GNet', '24.00 dB', '')]
    """
    initial = _metrics(chunk, "initial")
    gnet = _metrics(chunk, "gnet")
    fnet = _metrics(chunk, "fnet")
    enet = _metrics(chunk, "enet")
    # What FNet was given is scored with FNet's own evaluation, under another name.
    renders = {"shift_3m/psnr": fnet["shift_3m/render_psnr"]} if "shift_3m/render_psnr" in fnet else {}
    # GNet is compared with the initial scene and ENet with GNet's: each with what it was given.
    wanted = [
        ("Held-out PSNR after GNet", gnet, initial, "interpolation/psnr", "initial"),
        ("Held-out PSNR after ENet", enet, gnet, "interpolation/psnr", "GNet"),
        ("Fixed images at 3 m, PSNR", fnet, renders, "shift_3m/psnr", "renders"),
        ("Perceptual at 3 m after ENet", enet, gnet, "shift_3m/perceptual", "GNet"),
        ("Kernel at 3 m after ENet", enet, gnet, "shift_3m/kernel", "GNet"),
    ]
    headline = []
    for label, after, before, name, against in wanted:
        if name not in after:
            continue
        metric_format = METRIC_FORMATS[name.rpartition("/")[2]]
        # Other metrics have no unit.
        unit = " dB" if name.endswith("psnr") else ""
        change = ""
        if name in before:
            change = f"{_format_value(after[name] - before[name], metric_format, sign=True)} against {against}"
        headline.append((label, _format_value(after[name], metric_format) + unit, change))
    return headline


def build_metric_rows(stages: Mapping[str, StageSummary]) -> list[MetricRow]:
    """Builds the table of metrics: held-out frames first, then the shifts in order.

    Args:
        stages: summaries by stage name, those of :data:`SCORED_STAGES` that ran.

    Returns:
        The rows; a metric that no stage has, and one that is not in :data:`METRIC_FORMATS`, is left out.
    """
    measured = {name for stage in stages.values() for name in stage.metrics}
    groups = sorted({name.partition("/")[0] for name in measured}, key=_group_order)
    table: list[MetricRow] = []
    for group in groups:
        rows = []
        for prefix in ("", "render_"):
            for metric in METRIC_FORMATS:
                if f"{group}/{prefix}{metric}" in measured:
                    rows.append(_build_row(stages, group, prefix, metric))
        # A group of metrics that this version does not know is left out with its heading.
        if not rows:
            continue
        if f"{group}/n" in measured:
            rows.append(_build_count_row(stages, group))
        rows[0] = replace(rows[0], group=_group_label(group), size=len(rows))
        table += rows
    return table


def _build_row(stages: Mapping[str, StageSummary], group: str, prefix: str, metric: str) -> MetricRow:
    name = f"{group}/{prefix}{metric}"
    metric_format = METRIC_FORMATS[metric]
    scored = {stage: stages[stage] for stage in SCORED_STAGES if stage in stages and name in stages[stage].metrics}
    finite = {stage: s.metrics[name] for stage, s in scored.items() if math.isfinite(s.metrics[name])}
    # Values of different numbers of images are not of the same images: only the largest set competes.
    counts = {stage: stages[stage].metrics.get(f"{group}/n", 0.0) for stage in finite}
    rivals = {stage: value for stage, value in finite.items() if counts[stage] == max(counts.values())}
    best = None
    # Equal values have no winner.
    if len(set(rivals.values())) > 1:
        best = max(rivals.values()) if metric_format.higher_is_better else min(rivals.values())
    values: list[MetricValue | None] = []
    for stage in SCORED_STAGES:
        if stage not in scored:
            values.append(None)
            continue
        value = scored[stage].metrics[name]
        interval = ""
        if name in scored[stage].intervals:
            low, high = scored[stage].intervals[name]
            interval = f"{_format_value(low, metric_format)} … {_format_value(high, metric_format)}"
        values.append(MetricValue(_format_value(value, metric_format), interval, stage in rivals and value == best))
    label = f"{metric_format.label} of the renders given" if prefix else metric_format.label
    return MetricRow(label, "↑" if metric_format.higher_is_better else "↓", tuple(values))


def _build_count_row(stages: Mapping[str, StageSummary], group: str) -> MetricRow:
    counts = [stages[stage].metrics.get(f"{group}/n") if stage in stages else None for stage in SCORED_STAGES]
    values = tuple(None if count is None else MetricValue(f"{count:.0f}") for count in counts)
    return MetricRow("images", "", values)


def _metrics(chunk: ChunkSummary, name: str) -> Mapping[str, float]:
    stage = chunk.stage(name)
    return {} if stage is None else stage.metrics


def _format_value(value: float, metric_format: MetricFormat, sign: bool = False) -> str:
    if not math.isfinite(value):
        return "not finite"
    # A minus sign is as wide as a digit; a hyphen is not, and columns would not line up.
    return f"{value:{'+' if sign else ''}.{metric_format.decimals}f}".replace("-", "−")


def _group_order(group: str) -> tuple[bool, float, str]:
    shift = group.removeprefix("shift_").removesuffix("m")
    # False sorts before True: held-out frames first, then shifts by their size, then all else by name.
    return group != "interpolation", float(shift) if _is_number(shift) else math.inf, group


def _group_label(group: str) -> str:
    shift = group.removeprefix("shift_").removesuffix("m")
    if group == "interpolation":
        return "Held-out frames"
    if not _is_number(shift):
        return group
    return "Held-out frames, as a set" if float(shift) == 0 else f"{shift} m to the side"


def _is_number(text: str) -> bool:
    return text.replace(".", "", 1).isdigit()
