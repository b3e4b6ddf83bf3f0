"""The coloured LiDAR points as a scene of nearly opaque discs: what the fixer is shown of LiDAR, and its depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.config import InitialConfig
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk, Points
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.initial_gaussians import assemble_scene, fit_discs, max_points_per_actor, select_points
from genre_tasks.scene.rotations import quats_to_matrices_numpy
from genre_tasks.scene.transforms import distance_to_path
from genre_tasks.scene.voxel_grid import distance_octaves

LIDAR_OPACITY = 0.95

ACTOR_VOXEL_M = 0.05
"""On actors, points nearer than this are one disc: a ring's points would else have none but their own ring around."""

CLOSING = 0.5
"""In-plane standard deviation per distance to the next disc on either side, on actors."""

MAX_GAP_M = 0.8
"""What is farther is another part. From half a metre on ever less of a gap is closed: the next ring is then not among
the neighbours looked at."""

ISOLATED = 5.0
"""A disc is no surface if its fifth nearest return is so many times as far as that of the median disc of its octave."""

# Fewer are what a bird, a wire or a reflection gives.
_RETURNS = 5

# Neighbours looked at for the next disc.
_NEIGHBOURS = 32

# Neighbours lie on a disc's surface up to this distance from its plane, per distance along it.
_MAX_SLOPE = 0.7


def build_lidar_scene(chunk: Chunk, max_points: int) -> SceneGraph:
    """Turns a chunk's coloured LiDAR points into discs on the surfaces they lie on, nearly opaque.

    Discs, because the fixer looks images up by the map's depth: a ball as wide as its neighbours are far would stand
    out of a road that is seen at a grazing angle. Returns that stand alone are left out: a disc as wide as a voxel
    would hide the sky behind a wire or a reflection.

    Args:
        chunk: points without colour are left out.
        max_points: bounds the number of discs.

    Returns:
        A scene whose actors move and that has no distant region.
    """
    cap = max_points_per_actor(max_points, chunk)
    actors = [_fit_opaque_discs(a.points, np.zeros(len(a.points)), cap, ACTOR_VOXEL_M) for a in chunk.actors]
    distance = distance_to_path(chunk.static.positions, chunk.chunk_SE3_ego)
    # The background needs no closing: as the vehicle drives on, its rings sweep over all of it.
    static = _fit_opaque_discs(chunk.static, distance, max_points - sum(len(a) for a in actors))
    static = _remove_isolated(static, chunk)
    nothing_distant = Gaussians.unpack(torch.zeros(0, 14))
    return assemble_scene(chunk, static, nothing_distant, [close_gaps(a) for a in actors])


def _fit_opaque_discs(
    points: Points, distance: NDArray[np.floating], count: int, min_voxel_m: float = 0.0
) -> Gaussians:
    colored = points.colored
    if not colored.any():
        return Gaussians.unpack(torch.zeros(0, 14))
    config = InitialConfig(opacity=LIDAR_OPACITY)
    return fit_discs(select_points(points, colored), distance[colored], count, config, min_voxel_m)


def _remove_isolated(discs: Gaussians, chunk: Chunk) -> Gaussians:
    """Leaves out the background's discs that stand alone."""
    means = discs.means.double().numpy()
    octave = distance_octaves(distance_to_path(means, chunk.chunk_SE3_ego))
    isolated = torch.from_numpy(find_isolated(means, chunk.static.positions[chunk.static.colored], octave))
    return map_attributes(lambda values: values[~isolated], discs)


def find_isolated(means: Float64, returns: NDArray[np.floating], octave: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Finds discs that stand alone, as radius outlier removal does, with a radius from the recording's own density.

    Args:
        means: [N, 3] metres, of the discs.
        returns: [P, 3] metres, all that the discs were made from.
        octave: [N] of each disc's distance; discs are compared within an octave, as density falls with distance.

    Returns:
        [N] true where the fifth nearest return is more than ``ISOLATED`` times as far as that of the octave's median.
    """
    from scipy.spatial import cKDTree

    isolated = np.zeros(len(means), bool)
    # With so few returns there is no density to compare with.
    if len(returns) < _RETURNS:
        return isolated
    # A tree for few queries: building a balanced one would take longer than all of them.
    tree = cKDTree(returns, balanced_tree=False, compact_nodes=False)
    distance = tree.query(means, k=[_RETURNS])[0][:, 0]
    for k in np.unique(octave):
        of_octave = octave == k
        # Returns that repeat exactly, as of a simulated vehicle that stands, say nothing of the density.
        apart = distance[of_octave & (distance > 0)]
        if len(apart):
            isolated[of_octave] = distance[of_octave] > ISOLATED * np.median(apart)
    return isolated


def close_gaps(discs: Gaussians) -> Gaussians:
    """Widens discs along each of their two axes until they meet their neighbours on both sides.

    A car that drives along with the recording vehicle is met by the same few rings in every frame. Its points lie close
    within a ring and far from the next one: between discs as wide as the nearest points are far, the road behind would
    show.

    Args:
        discs: of one actor.

    Returns:
        The same discs with larger in-plane scales; discs at the outline do not grow beyond it.
    """
    if len(discs) < 2:
        return discs
    axes = quats_to_matrices_numpy(discs.quats.double().numpy())
    reach = CLOSING * _distance_to_next_disc(discs.means.double().numpy(), axes)
    in_plane = torch.from_numpy(reach).to(discs.log_scales).clamp_min(1e-9).log()
    # Never narrower than before, and the thickness stays: a thicker disc would stand out of its surface.
    log_scales = torch.cat([torch.maximum(discs.log_scales[:, :2], in_plane), discs.log_scales[:, 2:]], 1)
    return replace(discs, log_scales=log_scales)


def _distance_to_next_disc(means: Float64, axes: Float64) -> Float64:
    """Measures along a disc's first axis, and along its second, how far the next disc of the same surface is.

    Args:
        means: [N, 3] metres.
        axes: [N, 3, 3] columns: the two in-plane axes and the normal.

    Returns:
        Metres [N, 2], the farther of an axis's two directions; 0 where there is none within ``MAX_GAP_M``, as at the
        outline.
    """
    from scipy.spatial import cKDTree

    count = min(_NEIGHBOURS + 1, len(means))
    near = cKDTree(means).query(means, k=count)[1][:, 1:]
    along, across, off_plane = np.moveaxis(np.einsum("nkc,nca->nka", means[near] - means[:, None], axes), -1, 0)
    distance = np.hypot(along, across)
    same_surface = (np.abs(off_plane) < _MAX_SLOPE * distance) & (distance <= MAX_GAP_M)
    # Four directions: along each axis forwards and backwards.
    quarter = np.floor((np.arctan2(across, along) / np.pi + 1.25) * 2).astype(np.int64) % 4
    in_quarters = [np.where(same_surface & (quarter == q), distance, np.inf).min(1) for q in range(4)]
    nearest = np.stack(in_quarters, 1)
    nearest[~np.isfinite(nearest)] = 0
    return np.stack([np.maximum(nearest[:, k], nearest[:, k + 2]) for k in (0, 1)], 1)
