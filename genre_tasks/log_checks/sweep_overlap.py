"""Whether LiDAR sweeps lie on one another: what stands still must be at one place of the world in all of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.log_checks.pose_conventions import find_measurable, find_rigid, list_placements
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Float64
from genre_tasks.scene.transforms import invert_se3

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Pairs of sweeps that are compared, spread over the chunk: more of them tell nothing new.
_PAIRS = 3
# Farther apart, the wrong placement is clearer, and less of one sweep lies in the other.
_PAIR_TRAVEL_M = 3.0
_SURFACE_POINTS = 20_000
_QUERY_POINTS = 1_000
# Neighbours that make a plane: a ring alone would be a line.
_PLANE_NEIGHBOURS = 10
# Farther from the surface than this, a point is as wrong as it can be.
_MAX_MISFIT_M = 0.5
# The ground of a cell of so many metres; it looks the same wherever a sweep is placed on it.
_CELL_M = 3.0
_GROUND_M = 0.4
_RADIUS_M = 40.0
_MIN_POINTS = 200
_MIN_TRAVEL_M = 1.0
# A plane through neighbours that are farther away says nothing.
_NEAR_M = 1.0
# From the synthetic streets 900 to 999 and chunk 0 of the real sequence: see the benchmark ``log_faults``.
_MIN_MISFIT_M = 0.12
_MAX_RATIO = 0.7
# Another placement must fit as well as sound sweeps do, as one of twenty fits a little better by chance.
_MAX_GOOD_MISFIT_M = _MIN_MISFIT_M
_MAX_MISFIT_SOUND_M = 0.2
_REMEDY = "Give points in world coordinates, metres, by the poses of the same frames (sensor to world; w, x, y, z)."


@dataclass(frozen=True)
class SweepPair:
    """Two sweeps of a chunk that are compared.

    Attributes:
        query: [Q, 3] points of the first sweep, metres, relative to the origin of the comparison.
        surface: the points of the second sweep, as a tree.
        query_index: of the first sweep in the chunk.
        surface_index: of the second sweep in the chunk.
    """

    query: Float64
    surface: cKDTree
    query_index: int
    surface_index: int


def find_inconsistent_sweeps(sample: LogSample) -> Iterator[Finding]:
    """Finds sweeps that do not lie on one another where the log places them.

    Args:
        sample: the frames of a chunk.

    Yields:
        ``lidar_not_in_world`` where another placement fits clearly better, with its name, or ``sweeps_apart`` where
        sweeps fit nowhere. A vehicle that stands gives no verdict.
    """
    is_posed = find_rigid(sample.world_SE3_lidar)
    if not is_posed.any():
        return
    # Frames without a pose are in no pair.
    poses = np.where(is_posed[:, None, None], sample.world_SE3_lidar, np.eye(4))
    origin = poses[is_posed, :3, 3].mean(axis=0)
    pairs = select_pairs(sample, origin)
    if not pairs:
        return
    as_they_are = np.broadcast_to(np.eye(4), poses.shape)
    misfit_m = measure_misfit(pairs, as_they_are)
    if misfit_m < _MIN_MISFIT_M:
        return
    best_m = np.inf
    best_name = ""
    for placement in list_placements(poses):
        placed_m = measure_misfit(pairs, _shift_origin(placement.world_SE3_lidar, origin))
        if placed_m < best_m:
            best_m = placed_m
            best_name = placement.name
    frames = tuple(sorted({sample.frames[index] for pair in pairs for index in (pair.query_index, pair.surface_index)}))
    numbers = {"misfit_m": misfit_m, "best_misfit_m": best_m, "limit_ratio": _MAX_RATIO, "limit_m": _MAX_MISFIT_SOUND_M}
    if best_m < min(_MAX_RATIO * misfit_m, _MAX_GOOD_MISFIT_M):
        message = (
            f"the LiDAR sweeps do not overlap in the world ({misfit_m:.2f} m apart); "
            f"they fit better ({best_m:.2f} m) with {best_name}"
        )
        yield Finding("lidar_not_in_world", "warning", message, _REMEDY, numbers, frames=frames)
        return
    # The worst pair: a jump of the path is between the sweeps of one of them.
    worst_m = max(measure_misfit([pair], as_they_are) for pair in pairs)
    if worst_m > _MAX_MISFIT_SOUND_M:
        message = f"the LiDAR sweeps do not overlap: surfaces lie {worst_m:.2f} m apart"
        numbers["misfit_m"] = worst_m
        yield Finding("sweeps_apart", "warning", message, _REMEDY, numbers, frames=frames)


def select_pairs(sample: LogSample, origin: Float64) -> list[SweepPair]:
    """Selects sweeps between which the vehicle moved, spread over the chunk.

    Args:
        sample: the frames of a chunk.
        origin: [3] world coordinates of the origin of the comparison, near the path.

    Returns:
        The pairs; none where the vehicle stands or sweeps are missing.
    """
    positions = sample.world_SE3_lidar[:, :3, 3]
    posed = np.flatnonzero(find_rigid(sample.world_SE3_lidar))
    pairs = []
    for start in sorted({int(posed[k * len(posed) // _PAIRS]) for k in range(_PAIRS)} if len(posed) else ()):
        later = posed[posed > start]
        travel_m = np.linalg.norm(positions[later] - positions[start], axis=1)
        if not len(later) or travel_m.max() < _MIN_TRAVEL_M:
            continue
        far_enough = travel_m >= min(_PAIR_TRAVEL_M, travel_m.max())
        end = int(later[np.argmax(far_enough)])
        query = _read_standing_points(sample, start, origin)
        surface = _read_standing_points(sample, end, origin)
        if min(len(query), len(surface)) >= _MIN_POINTS:
            chosen = _thin(query, _QUERY_POINTS)
            pairs.append(SweepPair(chosen, _build_tree(_thin(surface, _SURFACE_POINTS)), start, end))
    return pairs


def _read_standing_points(sample: LogSample, index: int, origin: Float64) -> Float64:
    """[N, 3] points of a sweep that stand above the ground, relative to ``origin``; none where there is no sweep."""
    sweep = sample.sweep(sample.frames[index])
    if sweep is None or not len(sweep.points_world):
        return np.zeros((0, 3))
    points = sweep.points_world[find_measurable(sweep.points_world)] - origin
    if not len(points):
        return points
    # About the sweep's own middle: where the points lie is in question.
    points = points[np.linalg.norm(points - np.median(points, axis=0), axis=1) < _RADIUS_M]
    if not len(points):
        return points
    column, row = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / _CELL_M).astype(np.int64).T
    cell = row * (int(2 * _RADIUS_M / _CELL_M) + 2) + column
    lowest = np.full(cell.max() + 1, np.inf)
    np.minimum.at(lowest, cell, points[:, 2])
    return points[points[:, 2] > lowest[cell] + _GROUND_M]


def _thin(points: Float64, count: int) -> Float64:
    return points[:: max(1, -(-len(points) // count))]


def _build_tree(points: Float64) -> cKDTree:
    from scipy.spatial import cKDTree

    return cKDTree(points)


def _shift_origin(poses: Float64, origin: Float64) -> Float64:
    """Transforms [F, 4, 4] that take points relative to ``origin`` to where ``poses`` take the points themselves."""
    shifted = poses.copy()
    shifted[:, :3, 3] += poses[:, :3, :3] @ origin
    return shifted


def measure_misfit(pairs: Sequence[SweepPair], world_SE3_points: Float64) -> float:
    """Measures how far the points of sweeps are from the surfaces of later sweeps.

    Distances are to planes through neighbours: rings of a LiDAR move along a surface with the vehicle.

    Args:
        pairs: the sweeps.
        world_SE3_points: [F, 4, 4] places the points of every frame, as the pairs have them, in the world.

    Returns:
        Mean distance, metres; a point counts at most half a metre.
    """
    misfits_m = []
    for pair in pairs:
        surface_SE3_query = invert_se3(world_SE3_points[pair.surface_index]) @ world_SE3_points[pair.query_index]
        moved = pair.query @ surface_SE3_query[:3, :3].T + surface_SE3_query[:3, 3]
        misfits_m.append(_distance_to_surface(moved, pair.surface).mean())
    return float(np.mean(misfits_m))


def _distance_to_surface(query: Float64, surface: cKDTree) -> Float64:
    distance, index = surface.query(query, k=_PLANE_NEIGHBOURS)
    neighbours = surface.data[index]
    centre = neighbours.mean(axis=1)
    centred = neighbours - centre[:, None]
    _, axes = np.linalg.eigh(np.einsum("qki,qkj->qij", centred, centred))
    to_plane = np.abs(np.einsum("qi,qi->q", query - centre, axes[:, :, 0]))
    # Where nothing is near, a plane says nothing.
    return np.where(distance[:, 0] > _NEAR_M, _MAX_MISFIT_M, np.minimum(to_plane, _MAX_MISFIT_M))
