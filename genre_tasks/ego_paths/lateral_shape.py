"""Shapes of lateral manoeuvres over arc length: a step to the side, and a bump there and back.

The second derivative by arc length is made of straight lines. So at constant speed the lateral acceleration rises and
falls at a constant jerk and rests at its largest value: less of both than a polynomial of that length has.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.interpolate import PPoly

from genre_tasks.logs.types import Float64

_RAMP = 0.1
"""Share of a manoeuvre's length in which its second derivative rises from 0 to its largest amount."""


class LateralShape:
    """A curve over [0, 1] that starts and ends with slope and second derivative 0.

    Args:
        breaks: [B] from 0 to 1 where the second derivative bends.
        values: [B] second derivative there, in any unit.
    """

    def __init__(self, breaks: Float64, values: Float64) -> None:
        slopes = np.diff(values) / np.diff(breaks)
        second = PPoly(np.stack([slopes, values[:-1]]), breaks)
        raw = second.antiderivative(2)
        # Scaled to a largest value of 1, which both shapes have at a break.
        scale = 1.0 / float(np.abs(raw(breaks)).max())
        self._derivatives = tuple(PPoly(scale * p.c, p.x) for p in (raw, raw.derivative(), raw.derivative(2)))
        self.peak_second = scale * float(np.abs(values).max())
        self.peak_third = scale * float(np.abs(slopes).max())

    def evaluate(self, u: Float64, derivative: int = 0) -> Float64:
        """Evaluates the shape.

        Args:
            u: [N]; below 0 and above 1 the shape stays as it is there.
            derivative: 0, 1 or 2.

        Returns:
            [N].
        """
        values = np.asarray(self._derivatives[derivative](np.clip(u, 0.0, 1.0)), np.float64)
        return values if derivative == 0 else np.where((u < 0) | (u > 1), 0.0, values)


@cache
def build_step() -> LateralShape:
    """Builds a step from 0 to 1, for a lane change.

    Returns:
        The shape.

    >>> build_step().evaluate(np.array([0.0, 0.5, 1.0])).round(6).tolist()
    [0.0, 0.5, 1.0]
    """
    breaks = np.array([0.0, _RAMP, 0.5 - _RAMP, 0.5 + _RAMP, 1 - _RAMP, 1.0])
    return LateralShape(breaks, np.array([0.0, 1.0, 1.0, -1.0, -1.0, 0.0]))


@cache
def build_bump() -> LateralShape:
    """Builds a bump from 0 to 1 and back to 0, for a swerve.

    Returns:
        The shape.

    >>> build_bump().evaluate(np.array([0.0, 0.5, 1.0])).round(6).tolist()
    [0.0, 1.0, 0.0]
    """
    # Here the sign changes, so that the slope is 0 in the middle and at the end.
    turn = 0.25 * (1 + _RAMP)
    breaks = np.array([0.0, _RAMP, turn - _RAMP, turn + _RAMP, 0.5, 1 - turn - _RAMP, 1 - turn + _RAMP, 1 - _RAMP, 1.0])
    return LateralShape(breaks, np.array([0.0, 1.0, 1.0, -1.0, -1.0, -1.0, 1.0, 1.0, 0.0]))


@dataclass(frozen=True)
class LateralManoeuvre:
    """A lateral offset that changes by a shape on a stretch of the reference.

    Attributes:
        shape: of the change.
        start_offset_m: before it.
        amplitude_m: the largest change; to the left is positive.
        start_m: arc length where it begins.
        length_m: of the stretch, more than 0.
    """

    shape: LateralShape
    start_offset_m: float
    amplitude_m: float
    start_m: float
    length_m: float

    def evaluate(self, arc_m: Float64, derivative: int = 0) -> Float64:
        """Evaluates the offset.

        Args:
            arc_m: [N] arc length of the reference.
            derivative: by arc length: 0, 1 or 2.

        Returns:
            [N].
        """
        shape = self.shape.evaluate((arc_m - self.start_m) / self.length_m, derivative)
        change = self.amplitude_m * shape / self.length_m**derivative
        return change + self.start_offset_m if derivative == 0 else change
