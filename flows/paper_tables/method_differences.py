"""Paired differences of two methods over rollouts: over logs by Student's t, on one log by a bootstrap over frames."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flows.paper_tables.rollouts import BEHAVIOUR_LABELS

if TYPE_CHECKING:
    from flows.paper_tables.simulation_scores import RolloutRow
    from genre_tasks.rollout.rollout_scores import RealImages

COMPARED = ("psnr", "perceptual", "kernel")
"""The metrics that methods are compared in."""
MORE_IS_BETTER = ("psnr", "ssim")
CONFIDENCE = 0.95


@dataclass(frozen=True)
class MethodDifference:
    """How much one method differs from another.

    Attributes:
        behaviour: of the rollouts.
        metric: of their images.
        method: label of the first method.
        other: label of the second one.
        mean: the first method's value less that of the second one.
        low: lower end of the 95 % interval; NaN where there is none.
        high: upper end of it.
        n: number of logs.
    """

    behaviour: str
    metric: str
    method: str
    other: str
    mean: float
    low: float
    high: float
    n: int

    @property
    def is_better(self) -> bool:
        """Whether the first method is better, with an interval that excludes 0.

        >>> MethodDifference("brake", "kernel", "GenRe+", "3DGS", -0.2, -0.3, -0.1, 5).is_better
        True
        """
        # A comparison with NaN is false, so that a difference without an interval proves nothing.
        return self.low > 0 if self.metric in MORE_IS_BETTER else self.high < 0


def compare_methods(
    rows: Sequence[RolloutRow], method: str, other: str, metrics: Sequence[str] = COMPARED
) -> list[MethodDifference]:
    """Compares two methods by the logs that both were measured on.

    The rollouts of one behaviour on one log share a scene, so that their mean is one sample and a log is the unit.

    Args:
        rows: of both methods, and maybe of others.
        method: label of the first method.
        other: label of the second one.
        metrics: what is compared; a metric that a log lacks is not compared there.

    Returns:
        A difference for each behaviour and metric that any log has, with an interval where two logs have it.
    """
    out = []
    for behaviour in BEHAVIOUR_LABELS:
        for metric in metrics:
            first = _mean_by_log(rows, method, behaviour, metric)
            second = _mean_by_log(rows, other, behaviour, metric)
            differences = [first[log] - second[log] for log in first if log in second]
            if differences:
                mean, low, high = measure_mean_interval(differences)
                out.append(MethodDifference(behaviour, metric, method, other, mean, low, high, len(differences)))
    return out


def compare_on_log(
    rows: Sequence[RolloutRow], method: str, other: str, real: RealImages, bootstrap: int = 1000
) -> list[MethodDifference]:
    """Compares the kernel distances of two methods on one log, by resamples of its frames.

    Args:
        rows: of this log, of both methods.
        method: label of the first method.
        other: label of the second one.
        real: the log's real images, see :func:`genre_tasks.rollout.rollout_scores.collect_real_images`.
        bootstrap: number of resamples.

    Returns:
        A difference for each behaviour, over the images of all of its rollouts.
    """
    from genre_tasks.rollout.rollout_scores import compare_kernel_distances

    out = []
    for behaviour in BEHAVIOUR_LABELS:
        first = [r.scores for r in _select(rows, method, behaviour) if r.scores is not None]
        second = [r.scores for r in _select(rows, other, behaviour) if r.scores is not None]
        found = compare_kernel_distances(first, second, real, bootstrap) if first and second else None
        if found is not None:
            low = math.nan if found.low is None else found.low
            high = math.nan if found.high is None else found.high
            out.append(MethodDifference(behaviour, "kernel", method, other, found.value, low, high, n=1))
    return out


def measure_mean_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Measures a mean and its 95 % interval by Student's t.

    Args:
        values: independent samples, at least one.

    Returns:
        (mean, lower end, upper end); the ends are NaN for one sample.

    >>> [round(x, 3) for x in measure_mean_interval([1.0, 2.0, 3.0])]
    [2.0, -0.484, 4.484]
    """
    from scipy import stats

    mean = math.fsum(values) / len(values)
    if len(values) < 2:
        return mean, math.nan, math.nan
    error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    half = float(stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1)) * error
    return mean, mean - half, mean + half


def average_by_behaviour(rows: Iterable[RolloutRow]) -> dict[str, float]:
    """Averages the rollouts of one method on one log by behaviour.

    Args:
        rows: of one method and log.

    Returns:
        ``swerve/psnr`` and the like, the means over both sides, and ``swerve_left/psnr`` and the like of one rollout.
        A mean's ``/n`` is the number of images of all its rollouts.
    """
    rows = list(rows)
    values: dict[str, float] = {}
    for row in rows:
        values |= {f"{row.rollout.name}/{name}": value for name, value in row.metrics.items()}
        values[f"{row.rollout.name}/start_offset_m"] = row.start_offset_m
        values[f"{row.rollout.name}/strength"] = row.strength
    for behaviour in BEHAVIOUR_LABELS:
        metrics = [row.metrics for row in rows if row.rollout.behaviour == behaviour]
        for name in _list_shared(metrics):
            total = math.fsum(m[name] for m in metrics)
            values[f"{behaviour}/{name}"] = total if name.endswith("/n") else total / len(metrics)
    return values


def _list_shared(metrics: Sequence[Mapping[str, float]]) -> list[str]:
    """The metrics that all rollouts have. Ends of intervals do not average, so they are not among them."""
    shared = [name for name in metrics[0] if all(name in m for m in metrics)] if metrics else []
    return [name for name in shared if not name.endswith(("/low", "/high"))]


def _select(rows: Iterable[RolloutRow], method: str, behaviour: str) -> list[RolloutRow]:
    return [row for row in rows if row.method == method and row.rollout.behaviour == behaviour]


def _mean_by_log(rows: Iterable[RolloutRow], method: str, behaviour: str, metric: str) -> dict[str, float]:
    values: dict[str, list[float]] = {}
    for row in _select(rows, method, behaviour):
        if metric in row.metrics:
            values.setdefault(row.log, []).append(row.metrics[metric])
    return {log: math.fsum(x) / len(x) for log, x in values.items()}
