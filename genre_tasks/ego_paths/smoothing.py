"""Smooth curves through jittering samples: quintic splines with little third derivative."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.sparse import csr_array, diags_array

from genre_tasks.logs.types import Float64

_DEGREE = 5
# Three points integrate the square of a quintic's third derivative without error.
_GAUSS_NODES = np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])
_GAUSS_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
_MIN_SAMPLES = 3
# Samples at one spot, as of a vehicle that stands, count a little together rather than not at all.
_MIN_WEIGHT = 0.05


class SmoothCurve:
    """A curve and its derivatives.

    Args:
        spline: over the parameter less ``origin``, of the values less ``offset``.
        origin: first parameter.
        offset: [K] first values, which keep world coordinates of millions of metres exact.
    """

    def __init__(self, spline: BSpline, origin: float, offset: Float64) -> None:
        self._spline = spline
        self._origin = origin
        self._offset = offset

    def evaluate(self, parameter: Float64, derivative: int = 0) -> Float64:
        """Evaluates the curve.

        Args:
            parameter: [M], within the fitted range.
            derivative: order; 0: the curve itself.

        Returns:
            [M, K].
        """
        values = np.asarray(self._spline(parameter - self._origin, nu=derivative), np.float64)
        return values + self._offset if derivative == 0 else values


def fit_smooth_curve(parameter: Float64, values: Float64, scale: float) -> SmoothCurve:
    """Fits a smooth curve to samples that jitter.

    It minimises, over the parameter u in units of ``scale``::

        ∫ |p(u) − y(u)|² du  +  ∫ |p'''(u)|² du

    So a wave of angular frequency ω comes through with 1 / (1 + (ω · scale)⁶), and parabolas come through unchanged.

    Args:
        parameter: [N] not falling: seconds or metres.
        values: [N, K].
        scale: in units of the parameter; waves shorter than about 2π times this are smoothed away.

    Returns:
        The curve.

    Raises:
        ValueError: fewer than two samples, or all at one parameter.

    >>> times = np.arange(5.0)
    >>> fit_smooth_curve(times, times[:, None] ** 2, 0.5).evaluate(times, 2).round(6).ravel().tolist()
    [2.0, 2.0, 2.0, 2.0, 2.0]
    """
    origin = float(parameter[0])
    offset = np.asarray(values[0], np.float64)
    x = np.asarray(parameter, np.float64) - origin
    y = np.asarray(values, np.float64) - offset
    if len(x) < 2 or x[-1] <= 0:
        raise ValueError(f"expected samples at two parameters or more, got {len(x)} over {x[-1] if len(x) else 0}")
    if len(np.unique(x)) < _MIN_SAMPLES:
        # Two samples say nothing of a parabola: a sample between them makes the line the answer.
        middle = 0.5 * x[-1]
        y_middle = 0.5 * (y[0] + y[-1])
        x = np.array([x[0], middle, x[-1]])
        y = np.stack([y[0], y_middle, y[-1]])
    intervals = max(1, round(x[-1] / scale))
    step = x[-1] / intervals
    knots = step * np.arange(-_DEGREE, intervals + _DEGREE + 1)
    design = csr_array(BSpline.design_matrix(x, knots, _DEGREE))
    weights = np.maximum(np.gradient(x) / scale, _MIN_WEIGHT * min(1.0, x[-1] / scale / len(x)))
    normal = design.T @ diags_array(weights) @ design + _penalise_third_derivative(knots, intervals, step, scale)
    banded = np.zeros((_DEGREE + 1, normal.shape[0]))
    for k in range(_DEGREE + 1):
        diagonal = normal.diagonal(k)
        banded[_DEGREE - k, k:] = diagonal
    coefficients = solveh_banded(banded, design.T @ (weights[:, None] * y))
    return SmoothCurve(BSpline(knots, coefficients, _DEGREE, extrapolate=True), origin, offset)


def _penalise_third_derivative(knots: Float64, intervals: int, step: float, scale: float) -> csr_array:
    """[C, C] matrix of ∫ |p'''|² over the parameter in units of ``scale``, for C coefficients."""
    nodes = (step * (np.arange(intervals)[:, None] + 0.5 * (1 + _GAUSS_NODES))).ravel()
    weights = np.tile(_GAUSS_WEIGHTS, intervals) * step / scale
    quadratic = csr_array(BSpline.design_matrix(nodes, knots[3:-3], _DEGREE - 3))
    count = intervals + _DEGREE
    # The knots are uniform, so that a derivative is a difference of coefficients.
    differences: Any = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count))
    third = quadratic @ differences * (scale / step) ** 3
    return cast(csr_array, csr_array(third.T @ diags_array(weights) @ third))
