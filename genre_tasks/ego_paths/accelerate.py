"""The behaviour accelerate: gains speed, up to the largest one that bounds and curves allow."""

from __future__ import annotations

import numpy as np

from genre_tasks.ego_paths.behaviour_request import BehaviourRequest
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.frenet import ConstantOffset, place_path
from genre_tasks.ego_paths.kinematics import find_bound_violations
from genre_tasks.ego_paths.plausibility import check_planned_path, check_rate
from genre_tasks.ego_paths.speed_profile import JERK_SHARE, SpeedProfile

_LIMIT_COUNT = 12


def plan_accelerate(request: BehaviourRequest) -> EgoPath:
    """Plans an accelerating vehicle.

    Args:
        request: strength 1 is the acceleration ``accelerating_m_s2``.

    Returns:
        The path. Where a curve lets it reach no more, it ends at a lower speed.

    Raises:
        ConfigError: the acceleration is more than the bounds allow.
    """
    bounds = request.config.bounds
    rate = check_rate(request, request.config.accelerating_m_s2, bounds.max_acceleration_m_s2, "acceleration")
    path = _reach_speed(request, rate, bounds.max_speed_m_s)
    if not find_bound_violations(path, bounds):
        return path
    start_m_s = float(request.reference.measure_speed(np.array([request.delay_s]))[0])
    end_m_s = min(bounds.max_speed_m_s, start_m_s + rate * (request.reference.duration_s - request.delay_s))
    # Curves limit the speed: the largest of several limits that keeps within the bounds.
    for limit_m_s in np.linspace(end_m_s, start_m_s, _LIMIT_COUNT):
        slower = _reach_speed(request, rate, float(limit_m_s))
        if not find_bound_violations(slower, bounds):
            return slower
    return check_planned_path(request, path)


def _reach_speed(request: BehaviourRequest, rate_m_s2: float, speed_m_s: float) -> EgoPath:
    progress = SpeedProfile(
        request.reference,
        start_s=request.delay_s,
        speed_m_s=speed_m_s,
        acceleration_m_s2=rate_m_s2,
        jerk_m_s3=JERK_SHARE * request.config.bounds.max_jerk_m_s3,
    )
    return place_path(request.reference, request.recorded, progress, ConstantOffset(request.start_offset_m))
