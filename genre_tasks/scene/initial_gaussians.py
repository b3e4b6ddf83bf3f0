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
from genre_tasks.scene.distant_shell import build_distant_shell
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC, SceneGraph
from genre_tasks.scene.road_colors import color_unseen_road
from genre_tasks.scene.road_completion import CELL_M
from genre_tasks.scene.rotations import matrices_to_quats
from genre_tasks.scene.transforms import distance_to_path
from genre_tasks.scene.voxel_grid import Voxels, distance_octaves, find_voxel_size, group_by_voxel

SPACING = 0.7
"""In-plane standard deviation per root-mean-square distance to the three nearest neighbours: discs just overlap."""

MIN_SCALE_M = 0.005
MAX_SCALE_M = 3.0

MAX_SCALE_VOXELS = 0.7
"""An isolated point is far from its neighbours and yet small: in-plane, at most so many of its voxel's sizes."""

NEIGHBOURHOOD = 0.4
"""Normals come from LiDAR points thinned to this fraction of a Gaussian's voxel: some sixteen in its surroundings."""

ACTOR_FRACTION = 0.05
"""Of the near Gaussians, at most this fraction goes to one actor, and at most half to all of them."""

COLOR_REACH = 4.0
"""A voxel without colour takes its nearest coloured neighbour's if that is within so many of its own spacings."""


def build_initial_scene(config: InitialConfig, chunk: Chunk) -> SceneGraph:
    """Turns a chunk's LiDAR points into the scene that optimisation starts from. Deterministic.

    Args:
        config: numbers of Gaussians, ranges, opacity.
        chunk: with coloured points.

    Returns:
        Background, actors and distant region, at most ``config.max_points + config.distant_count`` Gaussians.

    Raises:
        InputError: no point of the background is within ``config.max_range_m`` of the path.
    """
    # Actors first: they are small and seen from near, and the background can spare what they take.
    cap = max_points_per_actor(config.max_points, chunk)
    actors = [fit_discs(a.points, np.zeros(len(a.points)), cap, config) for a in chunk.actors]
    distance = distance_to_path(chunk.static.positions, chunk.chunk_SE3_ego)
    near = distance < config.max_range_m
    static_cap = config.max_points - sum(len(a) for a in actors)
    if not near.any():
        raise InputError(
            f"no LiDAR point lies within {config.max_range_m} m of the path",
            remedy="Raise initial.max_range_m, or choose other chunks.",
            log=chunk.log,
            chunk=chunk.index,
        )
    background = color_unseen_road(chunk.static, chunk.chunk_SE3_ego)
    static = fit_discs(select_points(background, near), distance[near], static_cap, config)
    distant = build_distant_shell(chunk, config.distant_count, config.distant_radius_m)
    return assemble_scene(chunk, static, distant, actors)


def assemble_scene(chunk: Chunk, static: Gaussians, distant: Gaussians, actors: Sequence[Gaussians]) -> SceneGraph:
    """Puts the parts of a scene together in one batch.

    Args:
        chunk: gives the actors' poses.
        static: background, chunk coordinates.
        distant: distant region, chunk coordinates; may be empty.
        actors: in the chunk's order, each in its box coordinates.

    Returns:
        The scene graph, static Gaussians first, then distant ones, then actor by actor.
    """
    parts = [static, distant, *actors]
    ids = [STATIC, DISTANT, *(FIRST_ACTOR + k for k in range(len(actors)))]
    nodes = torch.cat([torch.full((len(p),), k, dtype=torch.int64) for p, k in zip(parts, ids, strict=True)])
    # Contiguous tensors of one batch: kernels read them in place.
    packed = torch.cat([p.pack() for p in parts])
    actor_nodes = tuple(ActorNode(a.track_id, a.label, a.size_m, a.frames, a.chunk_SE3_box) for a in chunk.actors)
    return SceneGraph(map_attributes(torch.Tensor.contiguous, Gaussians.unpack(packed)), nodes, actor_nodes)


def max_points_per_actor(max_points: int, chunk: Chunk) -> int:
    """Bounds how many of ``max_points`` Gaussians one actor of a chunk may take.

    Args:
        max_points: of all near nodes together.
        chunk: gives the number of actors.

    Returns:
        At least 1.
    """
    return max(1, int(max_points * min(ACTOR_FRACTION, 0.5 / max(len(chunk.actors), 1))))


def select_points(points: Points, chosen: NDArray) -> Points:
    """Copies some of a node's points.

    Args:
        points: P of them.
        chosen: [P] bool, or indices.
    """
    return Points(points.positions[chosen], points.colors[chosen], points.colored[chosen], points.frames[chosen])


def fit_discs(
    points: Points, distance: NDArray, max_count: int, config: InitialConfig, min_voxel_m: float = 0.0
) -> Gaussians:
    """Covers a node's points with flat Gaussians on the surfaces that they lie on, one disc a voxel.

    Args:
        points: P of the node, in its coordinates.
        distance: [P] metres to the path; voxels double in size with each octave of it.
        max_count: of discs.
        config: opacity, and how many neighbours give a normal.
        min_voxel_m: voxels near the path are at least this large.

    Returns:
        At most ``max_count`` Gaussians.
    """
    octave = distance_octaves(distance)
    size = max(find_voxel_size(points.positions, octave, max_count), min_voxel_m)
    voxels = group_by_voxel(points.positions, octave, size)
    means = voxels.mean(points.positions)
    spacing = measure_neighbour_spacing(means, size)
    fine = group_by_voxel(points.positions, octave, max(NEIGHBOURHOOD * size, min_voxel_m)).mean(points.positions)
    # Normals from all points, positions from the voxels' means: the noise of single points averages out in both.
    axes, spread = estimate_surface_axes(means, fine, config.neighbours)
    voxel_size = size * np.exp2(voxels.mean(octave[:, None])[:, 0])
    in_plane = np.minimum(SPACING * spacing, MAX_SCALE_VOXELS * np.maximum(voxel_size, CELL_M))
    # No thicker than wide: where few points are left the spread along the normal is noise.
    scales = np.stack([in_plane, in_plane, np.minimum(spread[:, 2], in_plane)], 1).clip(MIN_SCALE_M, MAX_SCALE_M)
    colors = average_voxel_colors(points, voxels, means, spacing)
    # One opacity for all: the points themselves say nothing about it.
    logits = np.full(len(means), np.log(config.opacity / (1 - config.opacity)))
    return Gaussians(
        means=_as_float32(means),
        log_scales=_as_float32(np.log(scales)),
        quats=matrices_to_quats(torch.from_numpy(axes)).float(),
        logit_opacities=_as_float32(logits),
        colors=_as_float32(colors),
    )


def _as_float32(values: Float64) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def measure_neighbour_spacing(means: Float64, alone_m: float) -> Float64:
    """Measures how far the neighbours of each point are.

    Args:
        means: [N, 3] metres.
        alone_m: the result for a single point.

    Returns:
        Root-mean-square distance [N] to the three nearest others.

    >>> measure_neighbour_spacing(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), 1.0).tolist()
    [2.0, 2.0]
    """
    from scipy.spatial import cKDTree

    # Root mean square over three, as 3DGS initialises its scales.
    others = min(3, len(means) - 1)
    if others < 1:
        return np.full(len(means), alone_m)
    distance = cKDTree(means).query(means, k=others + 1)[0][:, 1:]
    return np.sqrt((distance**2).mean(1))


def estimate_surface_axes(means: Float64, cloud: Float64, neighbours: int) -> tuple[Float64, Float64]:
    """Estimates the surface that points lie on, as the principal axes of the points around each.

    Args:
        means: [N, 3] where surfaces are asked for.
        cloud: [P, 3] points on the surfaces.
        neighbours: how many of the nearest points count.

    Returns:
        Rotations [N, 3, 3], columns by falling spread so that the last one is the normal, right-handed and with a fixed
        sign; and standard deviations [N, 3] along them.
    """
    from scipy.spatial import cKDTree

    # A tree that is asked for more points than it has answers with indices out of range.
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
    # The cross product makes the axes right-handed, which a quaternion needs.
    axes[:, :, 2] = np.cross(axes[:, :, 0], axes[:, :, 1])
    # Rounding can leave an eigenvalue of a perfect plane slightly below zero.
    return axes, np.sqrt(values[:, ::-1].clip(0))


def average_voxel_colors(points: Points, voxels: Voxels, means: Float64, spacing: Float64) -> Float64:
    """Gives each voxel the mean colour of its coloured points, or a near voxel's, or grey.

    Args:
        points: P of the node.
        voxels: N, of these points.
        means: [N, 3] metres, the voxels' mean points.
        spacing: [N] metres; a voxel without colour takes one from at most ``COLOR_REACH`` times as far.

    Returns:
        [N, 3] sRGB in [0, 1].
    """
    from scipy.spatial import cKDTree

    # Points without colour are grey, and would fade the others.
    weights = points.colored.astype(np.float64)
    colors = voxels.mean(points.colors, weights) / 255.0
    known = np.bincount(voxels.voxel_of, weights, voxels.count) > 0
    if known.all():
        return colors
    # Grey is the least wrong for a colour that nobody knows.
    colors[~known] = 0.5
    if known.any():
        distance, nearest = cKDTree(means[known]).query(means[~known])
        # A colour from farther away is more likely another object's.
        close = distance < COLOR_REACH * spacing[~known]
        colors[np.flatnonzero(~known)[close]] = colors[known][nearest[close]]
    return colors
