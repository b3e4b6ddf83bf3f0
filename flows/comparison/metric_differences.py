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


def compare_common_means(pairs: Sequence[tuple[Mapping[str, Score], Mapping[str, Score]]]) -> list[dict[str, Any]]:
    """Arranges the means of each metric, over those chunks where both runs have it.

    Args:
        pairs: scores of A and of B, for each common chunk.

    Returns:
        Rows as of :func:`compare_scores`, with the number of ``chunks`` that the means are over. A metric of one run
        alone stands without the other's. One that both runs have, but never in the same chunk, is left out.

    >>> easy = {"shift_3m/psnr": Score(30.0)}
    >>> hard = {"shift_3m/psnr": Score(20.0)}
    >>> row = compare_common_means([(easy, easy), (hard, {})])[0]
    >>> row["chunks"], row["A"], row["B"]
    (1, 30.0, 30.0)
    """
    names_a = {name for a, _ in pairs for name in a}
    names_b = {name for _, b in pairs for name in b}
    # Chunks differ more than runs do: a mean over other chunks would show their difficulty as a difference of the runs.
    used_a = [{name: a[name] for name in a if name in b or name not in names_b} for a, b in pairs]
    used_b = [{name: b[name] for name in b if name in a or name not in names_a} for a, b in pairs]
    rows = []
    for row in compare_scores(average_scores(used_a), average_scores(used_b)):
        name = row["metric"]
        count = sum(name in a or name in b for a, b in zip(used_a, used_b, strict=True))
        rows.append({"metric": name, "chunks": count} | row)
    return rows


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
