"""The coloured LiDAR points as a scene of nearly opaque discs: what the fixer is shown of LiDAR, and its depth."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.config import InitialConfig
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk, Points
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.initial_gaussians import actor_cap, assembled, node_gaussians, select
from genre_tasks.scene.transforms import path_distance, quat_to_matrix

LIDAR_OPACITY = 0.95

ACTOR_VOXEL_M = 0.05
"""On actors, points nearer than this are one disc: a ring's points would else have none but their own ring around."""

CLOSING = 0.5
"""In-plane standard deviation per distance to the next disc on either side, on actors."""

MAX_GAP_M = 0.8
"""What is farther is another part. From half a metre on ever less of a gap is closed: the next ring is then not among
the neighbours looked at."""

_AROUND, _ONE_SURFACE = 32, 0.7
"""Neighbours looked at, and how far from a disc's plane they may be, per distance along it, to lie on its surface."""


def lidar_scene(chunk: Chunk, max_points: int) -> SceneGraph:
    """The coloured LiDAR points as discs on the surfaces they lie on, nearly opaque: actors move, nothing is distant.

    Discs, because the fixer looks images up by the map's depth: a ball as wide as its neighbours are far would stand
    out of a road that is seen at a grazing angle. Points without colour are left out.
    """
    cap = actor_cap(max_points, chunk)
    actors = [_discs(a.points, np.zeros(len(a.points)), cap, ACTOR_VOXEL_M) for a in chunk.actors]
    distance = path_distance(chunk.static.positions, chunk.chunk_SE3_ego)
    static = _discs(chunk.static, distance, max_points - sum(len(a) for a in actors))
    return assembled(chunk, static, Gaussians.unpacked(torch.zeros(0, 14)), [closed(a) for a in actors])


def _discs(points: Points, distance: NDArray[np.floating], count: int, min_voxel_m: float = 0.0) -> Gaussians:
    colored = points.colored
    if not colored.any():
        return Gaussians.unpacked(torch.zeros(0, 14))
    config = InitialConfig(opacity=LIDAR_OPACITY)
    return node_gaussians(select(points, colored), distance[colored], count, config, min_voxel_m)


def closed(discs: Gaussians) -> Gaussians:
    """The discs, widened along each of their two axes until they meet their neighbours on both sides.

    A car that drives along with the recording vehicle is met by the same few rings in every frame. Its points lie
    close within a ring and far from the next one: between discs as wide as the nearest points are far, the road behind
    would show.
    """
    if len(discs) < 2:
        return discs
    reach = CLOSING * _sideways(discs.means.double().numpy(), quat_to_matrix(discs.quats.double().numpy()))
    in_plane = torch.from_numpy(reach).to(discs.log_scales).clamp_min(1e-9).log()
    log_scales = torch.cat([torch.maximum(discs.log_scales[:, :2], in_plane), discs.log_scales[:, 2:]], 1)
    return Gaussians(discs.means, log_scales, discs.quats, discs.logit_opacities, discs.colors)


def _sideways(means: Float64, axes: Float64) -> Float64:
    """How far [N, 2] the nearest other of the same surface is along a disc's first axis, and along its second.

    The farther of both directions; 0 where there is none within ``MAX_GAP_M``, as at the outline.
    """
    from scipy.spatial import cKDTree

    count = min(_AROUND + 1, len(means))
    near = cKDTree(means).query(means, k=count)[1][:, 1:]
    along, across, off = np.moveaxis(np.einsum("nkc,nca->nka", means[near] - means[:, None], axes), -1, 0)
    distance = np.hypot(along, across)
    same = (np.abs(off) < _ONE_SURFACE * distance) & (distance <= MAX_GAP_M)
    quarter = np.floor((np.arctan2(across, along) / np.pi + 1.25) * 2).astype(np.int64) % 4
    nearest = np.stack([np.where(same & (quarter == q), distance, np.inf).min(1) for q in range(4)], 1)
    nearest[~np.isfinite(nearest)] = 0
    return np.stack([np.maximum(nearest[:, k], nearest[:, k + 2]) for k in (0, 1)], 1)
