"""Clouds of Gaussians moved, merged and made simpler, whatever the format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from genre_tasks.exchange.sh_rotation import rotate_sh
from genre_tasks.exchange.types import SH_REST_COUNTS, SplatCloud
from genre_tasks.logs.types import Float64
from genre_tasks.scene.rotations import matrices_to_quats, multiply_quats


def transform_cloud(cloud: SplatCloud, target_SE3_source: Float64) -> SplatCloud:
    """Moves a cloud rigidly: means, quaternions and spherical harmonics.

    Args:
        cloud: N Gaussians in source coordinates.
        target_SE3_source: [4, 4] a rotation and a translation in metres.

    Returns:
        The Gaussians in target coordinates; those of the identity have the same bits.

    >>> lifted = transform_cloud(SplatCloud.empty(), np.eye(4))
    >>> len(lifted)
    0
    """
    pose = np.asarray(target_SE3_source, np.float64)
    rotation = pose[:3, :3]
    means = cloud.means.astype(np.float64) @ rotation.T + pose[:3, 3]
    turn = matrices_to_quats(torch.from_numpy(np.ascontiguousarray(rotation)))
    quats = multiply_quats(turn, torch.from_numpy(cloud.quats.astype(np.float64)))
    return replace(
        cloud,
        means=means.astype(np.float32),
        quats=quats.numpy().astype(np.float32),
        sh_rest=rotate_sh(cloud.sh_rest, rotation),
    )


def with_sh_degree(cloud: SplatCloud, degree: int) -> SplatCloud:
    """Gives a cloud spherical harmonics up to a degree: cut off, or filled up with zeros.

    Args:
        cloud: any.
        degree: 0 to 4.

    Returns:
        The cloud itself where it has that degree.

    >>> with_sh_degree(SplatCloud.empty(sh_degree=4), 1).sh_degree
    1
    """
    count = SH_REST_COUNTS[degree]
    if cloud.sh_degree == degree:
        return cloud
    sh_rest = np.zeros((len(cloud), count, 3), np.float32)
    common = min(count, cloud.sh_rest.shape[1])
    sh_rest[:, :common] = cloud.sh_rest[:, :common]
    return replace(cloud, sh_rest=sh_rest)


def merge_clouds(clouds: Sequence[SplatCloud]) -> SplatCloud:
    """Joins clouds into one, of the highest degree of harmonics among them.

    Args:
        clouds: in one coordinate system.

    Returns:
        Their Gaussians in order. ``antialiased`` is what the clouds agree on, and ``None`` where they do not.

    >>> merge_clouds([SplatCloud.empty(1), SplatCloud.empty(2)]).sh_degree
    2
    """
    filled = [cloud for cloud in clouds if len(cloud)] or list(clouds)
    if not filled:
        return SplatCloud.empty()
    degree = max(cloud.sh_degree for cloud in filled)
    padded = [with_sh_degree(cloud, degree) for cloud in filled]
    stated = {cloud.antialiased for cloud in filled}
    return SplatCloud(
        means=np.concatenate([cloud.means for cloud in padded]),
        log_scales=np.concatenate([cloud.log_scales for cloud in padded]),
        quats=np.concatenate([cloud.quats for cloud in padded]),
        logit_opacities=np.concatenate([cloud.logit_opacities for cloud in padded]),
        sh_dc=np.concatenate([cloud.sh_dc for cloud in padded]),
        sh_rest=np.concatenate([cloud.sh_rest for cloud in padded]),
        antialiased=stated.pop() if len(stated) == 1 else None,
    )
