"""Compares a simulated sweep with the recorded one, ray by ray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from genre_tasks.lidar_simulation.simulate_sweep import SimulatedSweep
from genre_tasks.logs.types import Float64

TOLERANCE_M = 0.5
TOLERANCE_FRACTION = 0.05
"""A simulated range agrees with the recorded one within the larger of 0.5 m and 5 % of it."""


@dataclass(frozen=True)
class SweepComparison:
    """How well a simulated sweep agrees with the recorded one; all values within a range.

    Attributes:
        rays: rays with a recorded return within the range.
        median_range_error_m: the median of |simulated − recorded| over rays with both returns.
        mean_range_error_m: the mean of the same, which outlines and vegetation decide.
        hit_recall: of rays with a recorded return, the fraction with a simulated one, wherever that is.
        recall: of rays with a recorded return, the fraction whose simulated one agrees with it.
        hit_precision: of rays with a simulated return, the fraction with a recorded one, wherever that is.
        precision: of rays with a simulated return, the fraction whose recorded one agrees with it.
        chamfer_m: mean distance from a point to the nearest of the other sweep, averaged over both directions.
    """

    rays: int
    median_range_error_m: float
    mean_range_error_m: float
    hit_recall: float
    recall: float
    hit_precision: float
    precision: float
    chamfer_m: float


def compare_sweeps(simulated: SimulatedSweep, recorded_m: Float64, max_range_m: float = 40.0) -> SweepComparison:
    """Compares ranges of the same rays.

    Args:
        simulated: N rays.
        recorded_m: [N] metres as recorded along these rays; NaN where nothing came back.
        max_range_m: rays whose return is farther do not count: the recorded one's for errors and recall, the
            simulated one's for precision.

    Returns:
        NaN for what no ray says.
    """
    with np.errstate(invalid="ignore"):
        error = np.abs(simulated.range_m - recorded_m)
        agrees = error <= np.maximum(TOLERANCE_M, TOLERANCE_FRACTION * recorded_m)
        is_recorded = recorded_m <= max_range_m
        is_simulated = simulated.range_m <= max_range_m
    hit = np.isfinite(simulated.range_m)
    errors = error[is_recorded & hit]
    real_points = simulated.origins + simulated.directions * recorded_m[:, None]
    return SweepComparison(
        rays=int(is_recorded.sum()),
        median_range_error_m=float(np.median(errors)) if len(errors) else np.nan,
        mean_range_error_m=float(errors.mean()) if len(errors) else np.nan,
        hit_recall=_fraction(hit[is_recorded]),
        recall=_fraction(agrees[is_recorded]),
        hit_precision=_fraction(np.isfinite(recorded_m)[is_simulated]),
        precision=_fraction(agrees[is_simulated]),
        chamfer_m=_measure_chamfer(simulated.points[is_simulated], real_points[is_recorded]),
    )


def _fraction(chosen: np.ndarray) -> float:
    return float(chosen.mean()) if len(chosen) else np.nan


def _measure_chamfer(first: Float64, second: Float64) -> float:
    from scipy.spatial import cKDTree

    if not len(first) or not len(second):
        return np.nan
    there = cKDTree(second).query(first)[0].mean()
    back = cKDTree(first).query(second)[0].mean()
    return float((there + back) / 2)
