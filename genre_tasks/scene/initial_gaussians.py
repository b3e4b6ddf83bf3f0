"""The initial scene: near Gaussians as discs on LiDAR points, and a distant region (paper Sec. III-A)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.config import InitialConfig
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Chunk, Points
from genre_tasks.scene.distant_shell import distant_region
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC, SceneGraph
from genre_tasks.scene.road_completion import CELL_M
from genre_tasks.scene.transforms import matrix_to_quat, path_distance
from genre_tasks.scene.voxel_grid import Voxels, group, levels, voxel_size_for

SPACING = 0.7
"""In-plane standard deviation per root-mean-square distance to the three nearest neighbours: discs just overlap."""

MIN_SCALE_M, MAX_SCALE_M = 0.005, 3.0

MAX_SCALE_VOXELS = 0.7
"""An isolated point is far from its neighbours and yet small: in-plane, at most so many of its voxel's sizes."""

NEIGHBOURHOOD = 0.4
"""Normals come from LiDAR points thinned to this fraction of a Gaussian's voxel: some sixteen in its surroundings."""

ACTOR_SHARE = 0.05
"""Of the near Gaussians, at most this share goes to one actor, and at most half to all of them."""

COLOR_REACH = 4.0
"""A voxel without colour takes its nearest coloured neighbour's if that is within so many of its own spacings."""


def initial_scene(config: InitialConfig, chunk: Chunk) -> SceneGraph:
    """Background, actors and distant region of a chunk, deterministic. Raises ``InputError`` without near points."""
    cap = actor_cap(config.max_points, chunk)
    actors = [node_gaussians(a.points, np.zeros(len(a.points)), cap, config) for a in chunk.actors]
    distance = path_distance(chunk.static.positions, chunk.chunk_SE3_ego)
    near = distance < config.max_range_m
    left = config.max_points - sum(len(a) for a in actors)
    if not near.any():
        raise InputError(
            f"no LiDAR point lies within {config.max_range_m} m of the path",
            remedy="Raise initial.max_range_m, or choose other chunks.",
            log=chunk.log,
            chunk=chunk.index,
        )
    static = node_gaussians(select(chunk.static, near), distance[near], left, config)
    distant = distant_region(chunk, config.distant_count, config.distant_radius_m)
    return assembled(chunk, static, distant, actors)


def assembled(chunk: Chunk, static: Gaussians, distant: Gaussians, actors: Sequence[Gaussians]) -> SceneGraph:
    """The scene graph of its parts; ``actors`` in the chunk's order, in box coordinates."""
    parts = [static, distant, *actors]
    ids = [STATIC, DISTANT, *(FIRST_ACTOR + k for k in range(len(actors)))]
    nodes = torch.cat([torch.full((len(p),), k, dtype=torch.int64) for p, k in zip(parts, ids, strict=True)])
    packed = torch.cat([p.packed() for p in parts])
    paths = tuple(ActorNode(a.track_id, a.label, a.size_m, a.frames, a.chunk_SE3_box) for a in chunk.actors)
    return SceneGraph(Gaussians(*(t.contiguous() for t in _fields(Gaussians.unpacked(packed)))), nodes, paths)


def _fields(g: Gaussians) -> tuple[torch.Tensor, ...]:
    return g.means, g.log_scales, g.quats, g.logit_opacities, g.colors


def actor_cap(max_points: int, chunk: Chunk) -> int:
    """How many of ``max_points`` one actor may take."""
    return max(1, int(max_points * min(ACTOR_SHARE, 0.5 / max(len(chunk.actors), 1))))


def select(points: Points, which: NDArray) -> Points:
    """The chosen points."""
    return Points(points.positions[which], points.colors[which], points.colored[which], points.frames[which])


def node_gaussians(
    points: Points, distance: NDArray, max_count: int, config: InitialConfig, min_voxel_m: float = 0.0
) -> Gaussians:
    """At most ``max_count`` discs on a node's points; voxels grow with ``distance`` [P] in octaves."""
    level = levels(distance)
    size = max(voxel_size_for(points.positions, level, max_count), min_voxel_m)
    voxels = group(points.positions, level, size)
    means = voxels.mean(points.positions)
    spacing = neighbour_spacing(means, size)
    fine = group(points.positions, level, max(NEIGHBOURHOOD * size, min_voxel_m)).mean(points.positions)
    rotation, spread = surface_frames(means, fine, config.neighbours)
    own = size * np.exp2(voxels.mean(level[:, None])[:, 0])
    plane = np.minimum(SPACING * spacing, MAX_SCALE_VOXELS * np.maximum(own, CELL_M))
    scales = np.stack([plane, plane, np.minimum(spread[:, 2], plane)], 1).clip(MIN_SCALE_M, MAX_SCALE_M)
    count = len(means)
    colors = voxel_colors(points, voxels, means, spacing)
    opacity = np.full(count, np.log(config.opacity / (1 - config.opacity)))
    tensor = [torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in (means, np.log(scales), opacity, colors)]
    quats = matrix_to_quat(torch.from_numpy(rotation)).float()
    return Gaussians(tensor[0], tensor[1], quats, tensor[2], tensor[3])


def neighbour_spacing(means: Float64, alone_m: float) -> Float64:
    """Root-mean-square distance [N] to the three nearest others; ``alone_m`` for a single point."""
    from scipy.spatial import cKDTree

    others = min(3, len(means) - 1)
    if others < 1:
        return np.full(len(means), alone_m)
    distance = cKDTree(means).query(means, k=others + 1)[0][:, 1:]
    return np.sqrt((distance**2).mean(1))


def surface_frames(means: Float64, cloud: Float64, neighbours: int) -> tuple[Float64, Float64]:
    """Principal axes of the points of ``cloud`` around each mean.

    Returns rotations [N, 3, 3], columns by falling spread (the last one is the normal), right-handed and with a fixed
    sign, and standard deviations [N, 3] along them.
    """
    from scipy.spatial import cKDTree

    k = min(neighbours, len(cloud))
    near = cKDTree(cloud).query(means, k=k)[1].reshape(len(means), k)
    offset = cloud[near] - cloud[near].mean(1, keepdims=True)
    covariance = np.einsum("nka,nkb->nab", offset, offset) / k
    values, vectors = np.linalg.eigh(covariance)
    axes = vectors[:, :, ::-1].copy()
    # Eigenvectors have no sign: the largest component of the first two is made positive, the third follows.
    for column in (0, 1):
        axis = axes[:, :, column]
        largest = np.take_along_axis(axis, np.abs(axis).argmax(1)[:, None], 1)
        axes[:, :, column] = axis * np.where(largest < 0, -1.0, 1.0)
    axes[:, :, 2] = np.cross(axes[:, :, 0], axes[:, :, 1])
    return axes, np.sqrt(values[:, ::-1].clip(0))


def voxel_colors(points: Points, voxels: Voxels, means: Float64, spacing: Float64) -> Float64:
    """Mean colour [N, 3] in [0, 1] of each voxel's coloured points; else the nearest coloured voxel's; else grey."""
    from scipy.spatial import cKDTree

    weights = points.colored.astype(np.float64)
    colors = voxels.mean(points.colors, weights) / 255.0
    known = np.bincount(voxels.which, weights, voxels.count) > 0
    if known.all():
        return colors
    colors[~known] = 0.5
    if known.any():
        distance, nearest = cKDTree(means[known]).query(means[~known])
        close = distance < COLOR_REACH * spacing[~known]
        colors[np.flatnonzero(~known)[close]] = colors[known][nearest[close]]
    return colors
