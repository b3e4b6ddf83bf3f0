"""A kinematic bicycle: how a vehicle moves that is steered and accelerated, within the bounds of what a car can do.

With speed v, heading θ, steering angle δ and wheelbase L: ẋ = v cos θ, ẏ = v sin θ, θ̇ = v tan δ / L. As for planned
paths, the vehicle points where its origin drives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from genre_tasks.config.simulation_sections import KinematicBounds

WHEELBASE_M = 2.8
"""Of a passenger car as long as ``EGO_SIZE_M``."""

MAX_STEER_RATE_RAD_S = 0.8
"""How fast front wheels turn in an emergency: a steering wheel at two turns a second, geared down by sixteen."""

_STEP_S = 0.01


@dataclass(frozen=True)
class VehicleState:
    """A vehicle at one moment.

    Attributes:
        x_m: of its origin in the world.
        y_m: of its origin in the world.
        heading_rad: counted from the world's x towards y.
        speed_m_s: forward, never negative.
        acceleration_m_s2: along the heading.
        steer_rad: angle of the front wheels; to the left is positive.
    """

    x_m: float
    y_m: float
    heading_rad: float
    speed_m_s: float
    acceleration_m_s2: float = 0.0
    steer_rad: float = 0.0


class BicycleModel:
    """Moves a vehicle; what is asked beyond a bound becomes the bound.

    Args:
        bounds: of speed, accelerations, jerk and curvature.
        wheelbase_m: distance of the axles.

    >>> model = BicycleModel(KinematicBounds())
    >>> state = VehicleState(0.0, 0.0, 0.0, speed_m_s=10.0)
    >>> braked = model.advance(state, acceleration_m_s2=-5.0, steer_rate_rad_s=0.0, seconds=1.0)
    >>> round(braked.speed_m_s, 1), braked.y_m
    (5.4, 0.0)
    """

    def __init__(self, bounds: KinematicBounds, wheelbase_m: float = WHEELBASE_M) -> None:
        self._bounds = bounds
        self._wheelbase_m = wheelbase_m
        self.max_steer_rad = self.find_steer(bounds.max_curvature_1_m)

    def find_curvature(self, steer_rad: float) -> float:
        """Gives the curvature in 1/m that a steering angle leads to.

        Args:
            steer_rad: of the front wheels.
        """
        return math.tan(steer_rad) / self._wheelbase_m

    def find_steer(self, curvature_1_m: float) -> float:
        """Gives the steering angle in radians that a curvature takes.

        Args:
            curvature_1_m: of the path.
        """
        return math.atan(curvature_1_m * self._wheelbase_m)

    def advance(
        self, state: VehicleState, acceleration_m_s2: float, steer_rate_rad_s: float, seconds: float
    ) -> VehicleState:
        """Moves a vehicle on.

        The acceleration changes no faster than the largest jerk allows. The steering angle turns no faster than wheels
        and the lateral jerk allow, and is no larger than curvature and lateral acceleration allow at that speed.

        Args:
            state: now.
            acceleration_m_s2: that is asked for; braking is negative. A standing vehicle does not drive backwards.
            steer_rate_rad_s: that is asked for; to the left is positive.
            seconds: how long.

        Returns:
            The state then.
        """
        steps = max(1, math.ceil(seconds / _STEP_S - 1e-9))
        for _ in range(steps):
            state = self._advance_briefly(state, acceleration_m_s2, steer_rate_rad_s, seconds / steps)
        return state

    def _advance_briefly(
        self, state: VehicleState, acceleration_m_s2: float, steer_rate_rad_s: float, step_s: float
    ) -> VehicleState:
        bounds = self._bounds
        wanted = _clip(acceleration_m_s2, -bounds.max_deceleration_m_s2, bounds.max_acceleration_m_s2)
        change = bounds.max_jerk_m_s3 * step_s
        acceleration = state.acceleration_m_s2 + _clip(wanted - state.acceleration_m_s2, -change, change)
        speed = _clip(state.speed_m_s + acceleration * step_s, 0.0, bounds.max_speed_m_s)
        # At a standstill and at the largest speed the vehicle keeps its speed.
        acceleration = min(acceleration, (speed - state.speed_m_s) / step_s) if acceleration > 0 else acceleration
        acceleration = max(acceleration, (speed - state.speed_m_s) / step_s) if acceleration < 0 else acceleration
        curvature = self._steer(state, speed, acceleration, steer_rate_rad_s, step_s)
        mean_speed = 0.5 * (state.speed_m_s + speed)
        turn = mean_speed * curvature * step_s
        middle_heading = state.heading_rad + 0.5 * turn
        return VehicleState(
            x_m=state.x_m + mean_speed * math.cos(middle_heading) * step_s,
            y_m=state.y_m + mean_speed * math.sin(middle_heading) * step_s,
            heading_rad=state.heading_rad + turn,
            speed_m_s=speed,
            acceleration_m_s2=acceleration,
            steer_rad=self.find_steer(curvature),
        )

    def _steer(
        self, state: VehicleState, speed_m_s: float, acceleration_m_s2: float, steer_rate_rad_s: float, step_s: float
    ) -> float:
        """Curvature after a short step."""
        bounds = self._bounds
        rate = _clip(steer_rate_rad_s, -MAX_STEER_RATE_RAD_S, MAX_STEER_RATE_RAD_S)
        steer = _clip(state.steer_rad + rate * step_s, -self.max_steer_rad, self.max_steer_rad)
        before = self.find_curvature(state.steer_rad)
        # The larger speed of the two, so that a bound holds within the step too.
        squared = max(speed_m_s, state.speed_m_s, 1e-3) ** 2
        # The lateral jerk of a path is v² κ̇ + 3 v a κ: the vehicle speeds up along a direction that turns.
        drift = 3 * speed_m_s * acceleration_m_s2 * before
        lowest = before + (-bounds.max_jerk_m_s3 - drift) / squared * step_s
        highest = before + (bounds.max_jerk_m_s3 - drift) / squared * step_s
        curvature = _clip(self.find_curvature(steer), min(lowest, highest), max(lowest, highest))
        limit = min(bounds.max_lateral_acceleration_m_s2 / squared, bounds.max_curvature_1_m)
        return _clip(curvature, -limit, limit)


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
