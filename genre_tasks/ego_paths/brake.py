"""The behaviour brake: slows down, to standstill at most."""

from __future__ import annotations

from genre_tasks.ego_paths.behaviour_request import BehaviourRequest
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.frenet import ConstantOffset, place_path
from genre_tasks.ego_paths.plausibility import check_planned_path, check_rate
from genre_tasks.ego_paths.speed_profile import JERK_SHARE, SpeedProfile


def plan_brake(request: BehaviourRequest) -> EgoPath:
    """Plans a braking vehicle.

    Args:
        request: strength 1 is the deceleration ``braking_m_s2``.

    Returns:
        The path.

    Raises:
        ConfigError: the deceleration is more than the bounds allow.
    """
    bounds = request.config.bounds
    rate = check_rate(request, request.config.braking_m_s2, bounds.max_deceleration_m_s2, "deceleration")
    progress = SpeedProfile(
        request.reference,
        start_s=request.delay_s,
        speed_m_s=0.0,
        acceleration_m_s2=rate,
        jerk_m_s3=JERK_SHARE * bounds.max_jerk_m_s3,
    )
    offset = ConstantOffset(request.start_offset_m)
    return check_planned_path(request, place_path(request.reference, request.recorded, progress, offset))
