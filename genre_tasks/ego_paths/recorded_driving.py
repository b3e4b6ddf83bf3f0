"""The behaviour recorded: drives as the recorded vehicle did, at the start offset."""

from __future__ import annotations

import numpy as np

from genre_tasks.ego_paths.behaviour_request import BehaviourRequest
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.plausibility import check_recorded_driving


def plan_recorded_driving(request: BehaviourRequest) -> EgoPath:
    """Moves the recorded poses to the side, and changes nothing else of them.

    Args:
        request: has the offset.

    Returns:
        The path; without an offset it has the recorded poses themselves.

    Raises:
        ConfigError: the recorded vehicle, or the moved one, breaks the bounds.
    """
    poses = request.recorded.world_SE3_ego.copy()
    lateral = poses[:, :2, 1] / np.linalg.norm(poses[:, :2, 1], axis=1, keepdims=True)
    # Level, as views beside the path are: a rolling vehicle would leave the ground.
    poses[:, :2, 3] += request.start_offset_m * lateral
    path = EgoPath(request.recorded.times_s, request.recorded.frames, poses)
    return check_recorded_driving(request, path)
