"""Progress along the reference whose acceleration changes at a bounded rate."""

from __future__ import annotations

import math

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from genre_tasks.ego_paths.reference_path import ReferencePath
from genre_tasks.logs.types import Float64

JERK_SHARE = 0.5
"""Of the jerk that the bounds allow, what behaviours use along the path; the rest is for curves and rounding."""

_STEP_S = 0.01
# A vehicle that is slower than a millimetre a second stands.
_STOPPED_M_S = 1e-3


class SpeedProfile:
    """Recorded progress up to a moment, and from then on towards a speed.

    Args:
        reference: of the recorded path.
        start_s: when it leaves the recorded progress.
        speed_m_s: that it ends at.
        acceleration_m_s2: largest amount of acceleration or deceleration on the way there.
        jerk_m_s3: largest change of the acceleration in a second.
    """

    def __init__(
        self,
        reference: ReferencePath,
        *,
        start_s: float,
        speed_m_s: float,
        acceleration_m_s2: float,
        jerk_m_s3: float,
    ) -> None:
        self._reference = reference
        self._start_s = start_s
        count = max(2, math.ceil((reference.duration_s - start_s) / _STEP_S) + 1)
        speed, acceleration = _measure_start(reference, start_s)
        speeds = np.empty(count)
        for i in range(count):
            speeds[i] = speed
            missing = speed_m_s - speed
            # The acceleration from which a constant jerk ends at the speed with none left.
            amount = min(acceleration_m_s2, math.sqrt(2 * jerk_m_s3 * abs(missing)))
            change = math.copysign(amount, missing) - acceleration
            acceleration += max(-jerk_m_s3 * _STEP_S, min(jerk_m_s3 * _STEP_S, change))
            speed = max(0.0, speed + acceleration * _STEP_S)
            if speed <= _STOPPED_M_S and missing <= 0:
                speed = 0.0
                acceleration = 0.0
        self._times = start_s + _STEP_S * np.arange(count)
        steps = 0.5 * (speeds[1:] + speeds[:-1]) * _STEP_S
        arc = float(reference.locate(np.array([start_s]))[0]) + np.concatenate([[0.0], np.cumsum(steps)])
        self._arc = CubicHermiteSpline(self._times, arc, speeds)

    def locate(self, times_s: Float64) -> Float64:
        """Finds the arc length.

        Args:
            times_s: [N] seconds since the first pose.

        Returns:
            [N] metres.
        """
        return np.where(times_s < self._start_s, self._reference.locate(times_s), self._arc(self._clip(times_s)))

    def measure_speed(self, times_s: Float64) -> Float64:
        """Finds the speed along the reference.

        Args:
            times_s: [N] seconds since the first pose.

        Returns:
            [N] m/s.
        """
        planned = self._arc(self._clip(times_s), nu=1)
        return np.where(times_s < self._start_s, self._reference.measure_speed(times_s), planned)

    def _clip(self, times_s: Float64) -> Float64:
        return np.clip(times_s, self._times[0], self._times[-1])


def _measure_start(reference: ReferencePath, start_s: float) -> tuple[float, float]:
    """Speed and acceleration at a moment of the recorded progress."""
    step = min(0.1, 0.25 * reference.duration_s)
    if step <= 0:
        return 0.0, 0.0
    middle = float(np.clip(start_s, step, reference.duration_s - step))
    before, now, after = reference.measure_speed(np.array([middle - step, start_s, middle + step]))
    return float(now), float((after - before) / (2 * step))
