"""Numbers over the views of several logs."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

import numpy as np

from benchmarks.common.bench import Row
from benchmarks.fixer.cells import ALL_INPUTS
from genre_tasks.metrics.scoring import BOOTSTRAP_SEED

RESAMPLES = 2000


def collect_views(streets: Sequence[Row], kind: str, key: str, scene: str = "truth") -> list[float]:
    """Collects one number of each view of all logs.

    Args:
        streets: rows with a truth.
        kind: ``render``, ``fixed`` or ``clean``.
        key: ``psnr`` or ``perceptual``.
        scene: ``truth``, or ``loose`` for renders of scenes whose ground is not constrained.

    Returns:
        One log after the other.
    """
    return [x for row in streets for x in row[scene][kind][key]]


def differences(streets: Sequence[Row], key: str, scene: str = "truth") -> list[float]:
    """Subtracts the render's number from the fixed view's, for each view; see :func:`collect_views`."""
    fixed = collect_views(streets, "fixed", key, scene)
    render = collect_views(streets, "render", key, scene)
    return [after - before for after, before in zip(fixed, render, strict=True)]


def reduced_parts(streets: Sequence[Row], scene: str = "truth") -> list[float]:
    """Computes by how much fixing reduces the perceptual distance.

    Args:
        streets: rows with a truth.
        scene: see :func:`collect_views`.

    Returns:
        For each view a part of the renders' mean distance.
    """
    # Divided by the mean and not view by view: a view with hardly any distance would dominate.
    base = collect_views(streets, "render", "perceptual", scene)
    return [-d / statistics.fmean(base) for d in differences(streets, "perceptual", scene)]


def reduced_parts_by_all_inputs(streets: Sequence[Row], fewer_inputs: str) -> list[float]:
    """Computes how much lower the perceptual distance is with all inputs than with fewer.

    Args:
        streets: rows with a truth.
        fewer_inputs: such as ``render+reference``.

    Returns:
        For each view a part of the mean with fewer inputs. Empty where a log lacks one of the two.
    """
    # Means over different logs could not be compared.
    if not all({fewer_inputs, ALL_INPUTS} <= set(row["inputs"]) for row in streets):
        return []
    fewer = [x for row in streets for x in row["inputs"][fewer_inputs]["perceptual"]]
    every = [x for row in streets for x in row["inputs"][ALL_INPUTS]["perceptual"]]
    return [(a - b) / statistics.fmean(fewer) for a, b in zip(fewer, every, strict=True)]


def mean(values: Sequence[float]) -> float | None:
    """Averages values; ``None`` where nothing was measured.

    >>> mean([1.0, 2.0])
    1.5
    """
    return statistics.fmean(values) if values else None


def interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Computes a bootstrap interval of the mean.

    Args:
        values: one of each view.

    Returns:
        Bounds of 95 % of the means of resampled views; ``None`` without a value.

    >>> low, high = interval([0.0, 1.0] * 20)
    >>> low < 0.5 < high
    True
    """
    if not values:
        return None
    # A fixed seed, so that claims of the same rows never change.
    drawn = np.random.default_rng(BOOTSTRAP_SEED).choice(values, (RESAMPLES, len(values)))
    low, high = np.quantile(drawn.mean(1), [0.025, 0.975])
    return float(low), float(high)


def seconds_a_view(row: Row) -> float:
    """Divides the seconds of the median run by its views."""
    # The median run, because the first one is slower and others may be disturbed.
    return float(statistics.median(row["time"]["seconds"]) / row["time"]["views"])
