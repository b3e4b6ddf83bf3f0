"""Smooth curves through jittering samples: quintic splines with little third derivative."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded

from genre_tasks.logs.types import Float64

_DEGREE = 5
# Of the derivative that is to be small; so many points also integrate its square without error.
_ORDER = 3
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
    weights = np.maximum(np.gradient(x) / scale, _MIN_WEIGHT * min(1.0, x[-1] / scale / len(x)))
    # Banded by hand: sparse matrices of this size would take ten times as long to build.
    interval = np.minimum((x / step).astype(np.int64), intervals - 1)
    basis = np.vander(x / step - interval, _DEGREE + 1) @ _cardinal_basis()
    count = intervals + _DEGREE
    penalty = _penalise_third_derivative() * (scale / step) ** (2 * _ORDER - 1)
    # Pairs of splines that share an interval; the upper half of a symmetric matrix.
    row, column = np.triu_indices(_DEGREE + 1)
    every = np.arange(intervals)
    index = np.concatenate([interval[:, None] + column, every[:, None] + column]) + count * (_DEGREE - column + row)
    products = np.concatenate(
        [(weights[:, None] * basis)[:, row] * basis[:, column], np.tile(penalty[row, column], (intervals, 1))]
    )
    banded = np.bincount(index.ravel(), products.ravel(), (_DEGREE + 1) * count).reshape(_DEGREE + 1, count)
    index = (interval[:, None] + np.arange(_DEGREE + 1)).ravel()
    right = [np.bincount(index, ((weights * values)[:, None] * basis).ravel(), count) for values in y.T]
    coefficients = solveh_banded(banded, np.stack(right, axis=1))
    knots = step * np.arange(-_DEGREE, intervals + _DEGREE + 1)
    return SmoothCurve(BSpline(knots, coefficients, _DEGREE, extrapolate=True), origin, offset)


@cache
def _cardinal_basis() -> Float64:
    """[6, 6] polynomials of the six quintic B-splines that an interval of length 1 has: powers 5 to 0, splines."""
    knots = np.arange(-_DEGREE, _DEGREE + 2, dtype=np.float64)
    spline = BSpline(knots, np.eye(_DEGREE + 1), _DEGREE)
    # The series of Taylor at the interval's start, which a polynomial is equal to.
    series = [spline(0.0, nu=power) / math.factorial(power) for power in range(_DEGREE, -1, -1)]
    return np.asarray(series, np.float64)


@cache
def _penalise_third_derivative() -> Float64:
    """[6, 6] integrals of products of the third derivatives of those B-splines."""
    nodes, weights = np.polynomial.legendre.leggauss(_ORDER)
    powers = [np.polyder(polynomial, _ORDER) for polynomial in _cardinal_basis().T]
    values = np.stack([np.polyval(polynomial, 0.5 * (1 + nodes)) for polynomial in powers])
    return np.asarray((values * 0.5 * weights) @ values.T, np.float64)
