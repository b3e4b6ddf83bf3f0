"""The shortest stretch on which a lateral manoeuvre keeps within the bounds."""

from __future__ import annotations

import math

import numpy as np

from genre_tasks.config.simulation_sections import KinematicBounds
from genre_tasks.ego_paths.behaviour_request import BehaviourRequest
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.frenet import measure_lateral_motion, place_path
from genre_tasks.ego_paths.kinematics import find_bound_violations
from genre_tasks.ego_paths.lateral_shape import LateralManoeuvre, LateralShape
from genre_tasks.ego_paths.plausibility import describe_violations
from genre_tasks.errors import ConfigError

_LENGTH_COUNT = 12
_STRENGTH_COUNT = 8
_DENSE_S = 0.02
_SHORTEST_M = 1.0


def plan_lateral(request: BehaviourRequest, shape: LateralShape) -> EgoPath:
    """Plans a lateral manoeuvre at the recorded progress along the road.

    Args:
        request: strength 1 is ``lane_m`` to the side.
        shape: of the manoeuvre.

    Returns:
        The path with the shortest manoeuvre that keeps within the bounds; where none does and that is allowed, the one
        that would on a straight road, as far as the recorded path goes.

    Raises:
        ConfigError: the recorded path is too short for it; the error says for what strength it is long enough.
    """
    path = _find_shortest(request, shape, request.strength)
    if path is None and request.allow_implausible:
        path = _plan_out_of_bounds(request, shape)
    if path is None:
        raise _explain_shortage(request, shape)
    return path


def _find_shortest(request: BehaviourRequest, shape: LateralShape, strength: float) -> EgoPath | None:
    start_m, available_m = _measure_stretch(request)
    amplitude_m = request.signed_side * strength * request.config.lane_m
    needed_m = _estimate_length(request, shape, strength)
    if available_m < _SHORTEST_M or needed_m > 1.5 * available_m:
        return None
    # The estimate is for a straight road at constant speed, so that it is now too long and now too short.
    lengths = np.geomspace(min(max(0.8 * needed_m, _SHORTEST_M), available_m), available_m, _LENGTH_COUNT)
    for length_m in lengths:
        offset = LateralManoeuvre(shape, request.start_offset_m, amplitude_m, start_m, float(length_m))
        if not _is_within_bounds(request, offset):
            continue
        path = place_path(request.reference, request.recorded, request.reference, offset)
        if not find_bound_violations(path, request.config.bounds):
            return path
    return None


def _plan_out_of_bounds(request: BehaviourRequest, shape: LateralShape) -> EgoPath | None:
    start_m, available_m = _measure_stretch(request)
    if available_m < _SHORTEST_M:
        return None
    amplitude_m = request.signed_side * request.strength * request.config.lane_m
    length_m = min(max(_estimate_length(request, shape, request.strength), _SHORTEST_M), available_m)
    offset = LateralManoeuvre(shape, request.start_offset_m, amplitude_m, start_m, length_m)
    return place_path(request.reference, request.recorded, request.reference, offset)


def _is_within_bounds(request: BehaviourRequest, offset: LateralManoeuvre) -> bool:
    """Without smoothing: a jerk of a tenth of a second must not hide between the poses of a log."""
    bounds = request.config.bounds
    reference = request.reference
    times = np.linspace(0.0, reference.duration_s, max(8, round(reference.duration_s / _DENSE_S)) + 1)
    motion = measure_lateral_motion(reference, times, reference, offset)
    if motion is None:
        return False
    return bool(
        np.abs(motion.curvature_1_m).max() <= bounds.max_curvature_1_m
        and np.abs(motion.lateral_acceleration_m_s2).max() <= bounds.max_lateral_acceleration_m_s2
        and np.abs(motion.lateral_jerk_m_s3).max() <= bounds.max_jerk_m_s3
    )


def _measure_stretch(request: BehaviourRequest) -> tuple[float, float]:
    """Arc length at the begin of the manoeuvre, and how much of the recorded path is left there."""
    start_m = float(request.reference.locate(np.array([request.delay_s]))[0])
    return start_m, request.reference.length_m - start_m


def _measure_top_speed(request: BehaviourRequest) -> float:
    times = np.linspace(request.delay_s, request.reference.duration_s, 50)
    return float(request.reference.measure_speed(times).max())


def _estimate_length(request: BehaviourRequest, shape: LateralShape, strength: float) -> float:
    """Metres that the manoeuvre takes on a straight road at the largest speed."""
    bounds: KinematicBounds = request.config.bounds
    amplitude_m = strength * request.config.lane_m
    speed = _measure_top_speed(request)
    return max(
        math.sqrt(shape.peak_second * amplitude_m / bounds.max_curvature_1_m),
        speed * math.sqrt(shape.peak_second * amplitude_m / bounds.max_lateral_acceleration_m_s2),
        speed * math.cbrt(shape.peak_third * amplitude_m / bounds.max_jerk_m_s3),
    )


def _explain_shortage(request: BehaviourRequest, shape: LateralShape) -> ConfigError:
    start_m, available_m = _measure_stretch(request)
    amplitude_m = request.strength * request.config.lane_m
    needed_m = _estimate_length(request, shape, request.strength)
    problem = (
        f"{request.name} of {amplitude_m:.2g} m takes about {needed_m:.1f} m of straight driving at "
        f"{_measure_top_speed(request):.1f} m/s; the recorded path has {available_m:.1f} m of it "
        f"after {request.delay_s:.1f} s"
    )
    if available_m >= _SHORTEST_M:
        signed_m = request.signed_side * amplitude_m
        longest = LateralManoeuvre(shape, request.start_offset_m, signed_m, start_m, available_m)
        path = place_path(request.reference, request.recorded, request.reference, longest)
        violations = find_bound_violations(path, request.config.bounds)
        if violations:
            problem += f", where it breaks the bounds: {describe_violations(violations)}"
    remedies = []
    possible = find_largest_strength(request, shape)
    if possible > 0:
        remedies.append(f"`--strength {possible:g}`")
    if request.delay_s > 0:
        remedies.append("`--delay 0`")
    remedies.append("more chunks")
    return ConfigError(problem, remedy=f"Try {', or '.join(remedies)}.")


def find_largest_strength(request: BehaviourRequest, shape: LateralShape) -> float:
    """Finds the largest strength, up to the requested one, for which the recorded path is long enough.

    Args:
        request: of the manoeuvre.
        shape: of it.

    Returns:
        The strength in steps of 0.01; 0 if there is none.
    """
    possible = 0
    impossible = math.ceil(100 * request.strength)
    for _ in range(_STRENGTH_COUNT):
        middle = (possible + impossible) // 2
        if middle == possible:
            break
        if _find_shortest(request, shape, middle / 100) is None:
            impossible = middle
        else:
            possible = middle
    return possible / 100
