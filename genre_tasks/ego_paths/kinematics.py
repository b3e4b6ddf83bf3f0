"""How a path moves: speed, accelerations, jerks and curvature, and where it breaks the bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from genre_tasks.config.simulation_sections import KinematicBounds
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.reference_path import SMOOTHING_S, STRAIGHT_M, integrate_speed
from genre_tasks.ego_paths.smoothing import fit_smooth_curve
from genre_tasks.logs.types import Float64

_SMOOTHING_M = 0.6
"""Scale of the curve over arc length: half a car's turning radius comes through by 90 %, and a centimetre of jitter at
10 Hz comes to a twentieth of a car's largest curvature."""

_SAMPLES_PER_SMOOTHING = 6
# A slower vehicle's direction of motion is that of its jitter.
_CRAWLING_M_S = 0.5
# Jitter of a standing vehicle looks as fast as this.
_STANDING_M_S = 0.2
# Who leaves so much of the smooth shape out on the way turns more sharply than it can follow.
_SHORTENED = 0.7
# As exact as the measurement is: a circle at the largest curvature does not break the bound.
_TOLERANCE = 0.01


@dataclass(frozen=True)
class Kinematics:
    """The motion of a path in the ground plane.

    Attributes:
        times_s: [T] seconds since the first pose.
        speed_m_s: [T].
        acceleration_m_s2: [T] along the path; braking is negative.
        lateral_acceleration_m_s2: [T] speed times turn rate; to the left is positive.
        jerk_m_s3: [T] change of the acceleration along the path.
        lateral_jerk_m_s3: [T] change of the lateral acceleration.
        curvature_1_m: [T]; to the left is positive.
    """

    times_s: Float64
    speed_m_s: Float64
    acceleration_m_s2: Float64
    lateral_acceleration_m_s2: Float64
    jerk_m_s3: Float64
    lateral_jerk_m_s3: Float64
    curvature_1_m: Float64


@dataclass(frozen=True)
class BoundViolation:
    """A quantity that leaves its bound.

    Attributes:
        quantity: speed, acceleration, deceleration, jerk, lateral jerk, lateral acceleration or curvature.
        value: the largest amount.
        bound: that it must not exceed.
        time_s: of the largest amount, seconds since the first pose.
        unit: of both.
    """

    quantity: str
    value: float
    bound: float
    time_s: float
    unit: str

    def __str__(self) -> str:
        return f"{self.quantity} of {self.value:.3g} {self.unit} at {self.time_s:.1f} s (bound {self.bound:g})"


def measure_kinematics(path: EgoPath) -> Kinematics:
    """Measures how a path moves.

    Positions are finite samples, and recorded ones jitter. So the motion is that of a smooth curve next to them, over
    time: motion of a period below 0.9 s is taken for jitter, see ``fit_smooth_curve``. The curvature is that of a
    smooth curve over arc length, since a slow vehicle's direction over time is that of its jitter; a standing one has
    none.

    Args:
        path: of any number of poses; fewer than two stand.

    Returns:
        The motion at several moments between two poses.
    """
    times = path.times_s - path.times_s[0] if len(path) else np.zeros(1)
    if len(path) < 2:
        zeros = np.zeros(1)
        return Kinematics(zeros, zeros, zeros, zeros, zeros, zeros, zeros)
    curve = fit_smooth_curve(times, path.world_SE3_ego[:, :2, 3], SMOOTHING_S)
    count = max(2, round(times[-1] / SMOOTHING_S * _SAMPLES_PER_SMOOTHING))
    dense = np.linspace(0.0, times[-1], count + 1)
    velocity = curve.evaluate(dense, 1)
    acceleration = curve.evaluate(dense, 2)
    jerk = curve.evaluate(dense, 3)
    speed = np.linalg.norm(velocity, axis=1)
    floor = np.maximum(speed, 1e-3)
    along = velocity / floor[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    forward = np.einsum("tk,tk->t", along, acceleration)
    lateral = np.einsum("tk,tk->t", across, acceleration)
    # Of a vector in turning axes: the turn rate carries one component over to the other.
    turn_rate = lateral / np.maximum(speed, _CRAWLING_M_S)
    curvature = _measure_curvature(times, path.world_SE3_ego[:, :2, 3], dense, speed)
    lost_turns = np.isnan(curvature)
    curvature[lost_turns] = (turn_rate / np.maximum(speed, _CRAWLING_M_S))[lost_turns]
    return Kinematics(
        times_s=dense,
        speed_m_s=speed,
        acceleration_m_s2=forward,
        lateral_acceleration_m_s2=lateral,
        jerk_m_s3=np.einsum("tk,tk->t", along, jerk) + turn_rate * lateral,
        lateral_jerk_m_s3=np.einsum("tk,tk->t", across, jerk) - turn_rate * forward,
        curvature_1_m=curvature,
    )


def _measure_curvature(times: Float64, positions: Float64, dense: Float64, speed: Float64) -> Float64:
    """[T] curvature over arc length; NaN where the vehicle turns more sharply than a smooth curve can follow."""
    distances = integrate_speed(dense, speed)
    if distances[-1] < STRAIGHT_M:
        return np.zeros(len(dense))
    curve = fit_smooth_curve(np.interp(times, dense, distances), positions, _SMOOTHING_M)
    tangent = curve.evaluate(distances, 1)
    change = curve.evaluate(distances, 2)
    norm = np.linalg.norm(tangent, axis=1)
    turning = tangent[:, 0] * change[:, 1] - tangent[:, 1] * change[:, 0]
    curvature = turning / np.maximum(norm, _SHORTENED) ** 3
    curvature[(norm < _SHORTENED) & (speed > _CRAWLING_M_S)] = np.nan
    return np.where(speed > _STANDING_M_S, curvature, 0.0)


def compare_with_bounds(motion: Kinematics, bounds: KinematicBounds) -> tuple[BoundViolation, ...]:
    """Finds where a motion leaves its bounds.

    Args:
        motion: of a path.
        bounds: that it has to stay within.

    Returns:
        The largest violation of every quantity; empty if there is none.
    """
    checks = (
        ("speed", motion.speed_m_s, bounds.max_speed_m_s, "m/s"),
        ("acceleration", motion.acceleration_m_s2, bounds.max_acceleration_m_s2, "m/s²"),
        ("deceleration", -motion.acceleration_m_s2, bounds.max_deceleration_m_s2, "m/s²"),
        ("jerk", np.abs(motion.jerk_m_s3), bounds.max_jerk_m_s3, "m/s³"),
        (
            "lateral acceleration",
            np.abs(motion.lateral_acceleration_m_s2),
            bounds.max_lateral_acceleration_m_s2,
            "m/s²",
        ),
        ("lateral jerk", np.abs(motion.lateral_jerk_m_s3), bounds.max_jerk_m_s3, "m/s³"),
        ("curvature", np.abs(motion.curvature_1_m), bounds.max_curvature_1_m, "1/m"),
    )
    violations = []
    for quantity, values, bound, unit in checks:
        worst = int(np.argmax(values))
        if values[worst] > bound * (1 + _TOLERANCE):
            violations.append(BoundViolation(quantity, float(values[worst]), bound, float(motion.times_s[worst]), unit))
    return tuple(violations)


def find_bound_violations(path: EgoPath, bounds: KinematicBounds) -> tuple[BoundViolation, ...]:
    """Checks whether a vehicle can drive a path.

    Args:
        path: planned, recorded or a user's.
        bounds: what a vehicle can do.

    Returns:
        The largest violation of every quantity; empty if the path is plausible.

    >>> standing = EgoPath(np.arange(3) * 0.1, np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    >>> find_bound_violations(standing, KinematicBounds())
    ()
    """
    return compare_with_bounds(measure_kinematics(path), bounds)
