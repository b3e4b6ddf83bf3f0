"""The behaviour swerve: moves to the side, and back again."""

from __future__ import annotations

from genre_tasks.ego_paths.behaviour_request import BehaviourRequest
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.lateral_search import plan_lateral
from genre_tasks.ego_paths.lateral_shape import build_bump


def plan_swerve(request: BehaviourRequest) -> EgoPath:
    """Plans a swerve.

    Args:
        request: strength 1 is ``lane_m`` to the side.

    Returns:
        The path.

    Raises:
        ConfigError: the recorded path is too short for it.
    """
    return plan_lateral(request, build_bump())
