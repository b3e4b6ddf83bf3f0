"""Metrics of two evaluations side by side, with differences and intervals."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flows.reconstruction.report.metric_table import METRIC_FORMATS


@dataclass(frozen=True)
class Score:
    """One metric of one evaluation.

    Attributes:
        value: the number.
        interval: its 95 % interval; ``None`` without one.
    """

    value: float
    interval: tuple[float, float] | None = None


def compare_scores(a: Mapping[str, Score], b: Mapping[str, Score]) -> list[dict[str, Any]]:
    """Arranges the metrics of two evaluations.

    Args:
        a: by the metric's name, such as ``interpolation/psnr``.
        b: the same of the second.

    Returns:
        Rows with the metric, both values, both intervals, B less A and which is better. The last word says ``clearly``
        where both intervals are known and do not overlap.

    >>> row = compare_scores({"shift_3m/psnr": Score(24.0)}, {"shift_3m/psnr": Score(25.5)})[0]
    >>> row["B − A"], row["B is"]
    (1.5, 'better')
    """
    names = dict.fromkeys([*a, *b])
    # Counts go last within their group; they are read after the numbers that they are of.
    order = sorted(names, key=lambda name: (name.rpartition("/")[0], name.endswith("/n")))
    return [_compare(name, a.get(name), b.get(name)) for name in order]


def average_scores(found: Sequence[Mapping[str, Score]]) -> dict[str, Score]:
    """Takes the mean of each metric over several evaluations.

    Args:
        found: of several chunks.

    Returns:
        By name, the mean over those that have the metric; without an interval.
    """
    names = dict.fromkeys(name for scores in found for name in scores)
    return {name: Score(statistics.fmean(s[name].value for s in found if name in s)) for name in names}


def _compare(name: str, a: Score | None, b: Score | None) -> dict[str, Any]:
    row: dict[str, Any] = {
        "metric": name,
        "A": "" if a is None else a.value,
        "interval A": _format_interval(a),
        "B": "" if b is None else b.value,
        "interval B": _format_interval(b),
        "B − A": "",
        "B is": "",
    }
    if a is None or b is None:
        return row
    # Two infinite values, of identical images, have no difference that is a number.
    row["B − A"] = 0.0 if a.value == b.value else b.value - a.value
    row["B is"] = _judge(name, a, b)
    return row


def _judge(name: str, a: Score, b: Score) -> str:
    metric = METRIC_FORMATS.get(name.rpartition("/")[2].removeprefix("render_"))
    if metric is None or a.value == b.value or math.isnan(a.value) or math.isnan(b.value):
        return ""
    word = "better" if (b.value > a.value) == metric.higher_is_better else "worse"
    if a.interval is None or b.interval is None:
        return word
    are_apart = a.interval[1] < b.interval[0] or b.interval[1] < a.interval[0]
    return f"clearly {word}" if are_apart else f"{word}, within the intervals"


def _format_interval(score: Score | None) -> str:
    if score is None or score.interval is None:
        return ""
    return f"{score.interval[0]:.4g} … {score.interval[1]:.4g}"
