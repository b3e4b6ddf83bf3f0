"""The behaviour lane-change: moves to the side, and stays there."""

from __future__ import annotations

from genre_tasks.ego_paths.behaviour_request import BehaviourRequest
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.lateral_search import plan_lateral
from genre_tasks.ego_paths.lateral_shape import build_step


def plan_lane_change(request: BehaviourRequest) -> EgoPath:
    """Plans a lane change.

    Args:
        request: strength 1 is ``lane_m`` to the side.

    Returns:
        The path.

    Raises:
        ConfigError: the recorded path is too short for it.
    """
    return plan_lateral(request, build_step())
