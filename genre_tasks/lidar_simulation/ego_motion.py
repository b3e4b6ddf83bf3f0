"""Where the ego vehicle is at any moment: a LiDAR turns for a tenth of a second, in which the vehicle drives on."""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.types import Float64
from genre_tasks.scene.transforms import compose_se3


def interpolate_poses(poses: Float64, moments: Float64, asked: Float64) -> Float64:
    """Interpolates poses: straight in position, by the shortest turn in rotation.

    Args:
        poses: [F, 4, 4], at least one.
        moments: [F] of the poses: seconds, or log frames; poses whose moment does not rise are left out.
        asked: [N] moments; outside of those of the poses, the motion at that end goes on.

    Returns:
        [N, 4, 4].

    >>> poses = compose_se3(np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 0], [2.0, 0, 0]]))
    >>> interpolate_poses(poses, np.array([0.0, 1.0]), np.array([0.25, 1.5]))[:, 0, 3].tolist()
    [0.5, 3.0]
    >>> poses = np.concatenate([poses, poses[1:]])
    >>> interpolate_poses(poses, np.array([0.0, 1.0, 1.0]), np.array([0.25, 1.5]))[:, 0, 3].tolist()
    [0.5, 3.0]
    """
    from scipy.spatial.transform import Rotation

    # Clocks repeat: between two equal moments there is no motion to go on with.
    rises = moments > np.r_[-np.inf, np.maximum.accumulate(moments)[:-1]]
    poses, moments = poses[rises], moments[rises]
    if len(poses) == 1:
        return np.repeat(poses, len(asked), axis=0)
    last = np.clip(np.searchsorted(moments, asked, side="right"), 1, len(moments) - 1)
    first = last - 1
    fraction = (asked - moments[first]) / (moments[last] - moments[first])
    steps = poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2)
    turns = Rotation.from_matrix(steps).as_rotvec()
    turned = Rotation.from_rotvec(fraction[:, None] * turns[first]).as_matrix() @ poses[first, :3, :3]
    shift = poses[last, :3, 3] - poses[first, :3, 3]
    return compose_se3(turned, poses[first, :3, 3] + fraction[:, None] * shift)
