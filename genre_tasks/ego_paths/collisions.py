"""Overlaps of the ego vehicle with actors along a path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.world_actors import WorldActor
from genre_tasks.logs.types import Float64

EGO_SIZE_M = (4.8, 2.0, 1.6)
"""Length, width and height of a passenger car. Its middle is at the origin where the log does not say otherwise:
PandaSet's LiDAR is above the middle of the roof, and so is the synthetic street's. See ``logs.vehicle_center``."""

_VERTICAL_REACH_M = 2.5
"""The origin of a path is on the road in some logs and at the roof in others: boxes within this height of it count.
What is left out is traffic on another level."""


@dataclass(frozen=True)
class Collision:
    """An overlap of the ego vehicle with an actor, from its first moment on.

    Attributes:
        time_s: of the first overlap, seconds since the first pose.
        frame: log frame, or moment between two, of the first overlap.
        actor_id: of the actor.
        label: its class.
        overlap_m: the largest depth along the path: the least shift in the ground plane that would part the boxes; 0
            where they only come nearer than the margin.
        gap_m: the least distance of the boxes; 0 where they overlap.
    """

    time_s: float
    frame: float
    actor_id: str
    label: str
    overlap_m: float
    gap_m: float

    def __str__(self) -> str:
        depth = f"{self.overlap_m:.2f} m deep" if self.overlap_m > 0 else f"{self.gap_m:.2f} m apart"
        return f"{self.label} {self.actor_id} at {self.time_s:.1f} s (frame {self.frame:g}), {depth}"


def find_collisions(
    path: EgoPath,
    actors: Sequence[WorldActor],
    margin_m: float,
    ego_size_m: tuple[float, float, float] = EGO_SIZE_M,
    center_ahead_m: float = 0.0,
) -> tuple[Collision, ...]:
    """Finds the actors that the ego vehicle runs into.

    Boxes are compared in the ground plane, by separating axes (Gottschalk et al., "OBBTree", SIGGRAPH 1996).

    Args:
        path: of the ego vehicle.
        actors: in the same world.
        margin_m: boxes that come nearer than this count too.
        ego_size_m: length, width and height of the ego vehicle.
        center_ahead_m: how far ahead of the path's poses the middle of the vehicle is.

    Returns:
        One entry for each actor, in the order of time.
    """
    if not len(path):
        return ()
    ego_heading = np.arctan2(path.world_SE3_ego[:, 1, 0], path.world_SE3_ego[:, 0, 0])
    ahead = np.stack([np.cos(ego_heading), np.sin(ego_heading)], axis=1)
    ego_center = path.world_SE3_ego[:, :2, 3] + center_ahead_m * ahead
    # With the vehicle's height, since the origin may be at its foot or on its roof.
    reach = max(_VERTICAL_REACH_M, ego_size_m[2])
    height = path.world_SE3_ego[:, 2, 3]
    collisions = []
    for actor in actors:
        boxes = actor.place_boxes(path.frames)
        near = boxes.exists & (boxes.top_m > height - reach) & (boxes.bottom_m < height + reach)
        if not near.any():
            continue
        depth, gap = measure_overlap(
            ego_center, ego_heading, ego_size_m[:2], boxes.center_m, boxes.heading_rad, actor.size_m[:2]
        )
        touching: NDArray[np.bool_] = near & ((depth > 0) | (gap < margin_m))
        if touching.any():
            first = int(np.argmax(touching))
            collision = Collision(
                time_s=float(path.times_s[first] - path.times_s[0]),
                frame=float(path.frames[first]),
                actor_id=actor.actor_id,
                label=actor.label,
                overlap_m=float(depth[touching].max()),
                gap_m=float(gap[touching].min()),
            )
            collisions.append(collision)
    return tuple(sorted(collisions, key=lambda collision: (collision.time_s, collision.actor_id)))


def measure_overlap(
    center_a: Float64,
    heading_a: Float64,
    size_a: tuple[float, float],
    center_b: Float64,
    heading_b: Float64,
    size_b: tuple[float, float],
) -> tuple[Float64, Float64]:
    """Measures how deep rectangles overlap, or how far apart they are.

    Args:
        center_a: [P, 2].
        heading_a: [P] radians.
        size_a: length and width.
        center_b: [P, 2].
        heading_b: [P] radians.
        size_b: length and width.

    Returns:
        Depth [P], 0 where they are apart, and gap [P], 0 where they overlap; metres.

    >>> origin = np.zeros((1, 2))
    >>> measure_overlap(origin, np.zeros(1), (4.0, 2.0), origin + [3.5, 0.0], np.zeros(1), (4.0, 2.0))
    (array([0.5]), array([0.]))
    """
    corners_a = _place_corners(center_a, heading_a, size_a)
    corners_b = _place_corners(center_b, heading_b, size_b)
    depths = []
    for heading in (heading_a, heading_a + 0.5 * np.pi, heading_b, heading_b + 0.5 * np.pi):
        axis = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        along_a = np.einsum("pck,pk->pc", corners_a, axis)
        along_b = np.einsum("pck,pk->pc", corners_b, axis)
        # Either way out: a small box inside of a large one leaves by the nearer side.
        depths.append(np.minimum(along_a.max(1) - along_b.min(1), along_b.max(1) - along_a.min(1)))
    depth = np.maximum(np.min(depths, axis=0), 0.0)
    # The nearest points of two rectangles that are apart are a corner and a side.
    gap = np.minimum(
        _measure_distance(corners_a, center_b, heading_b, size_b),
        _measure_distance(corners_b, center_a, heading_a, size_a),
    )
    return depth, np.where(depth > 0, 0.0, gap)


def _place_corners(center: Float64, heading: Float64, size: tuple[float, float]) -> Float64:
    """[P, 4, 2] corners of rectangles."""
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1) * (0.5 * size[0])
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=1) * (0.5 * size[1])
    return np.stack([center + a * ahead + b * left for a in (-1, 1) for b in (-1, 1)], axis=1)


def _measure_distance(points: Float64, center: Float64, heading: Float64, size: tuple[float, float]) -> Float64:
    """[P] least distance of points [P, C, 2] from rectangles."""
    offset = points - center[:, None]
    cosine = np.cos(heading)[:, None]
    sine = np.sin(heading)[:, None]
    outside_x = np.maximum(np.abs(cosine * offset[..., 0] + sine * offset[..., 1]) - 0.5 * size[0], 0.0)
    outside_y = np.maximum(np.abs(cosine * offset[..., 1] - sine * offset[..., 0]) - 0.5 * size[1], 0.0)
    return np.asarray(np.hypot(outside_x, outside_y).min(1), np.float64)
