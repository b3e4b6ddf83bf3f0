"""Annotations: a cuboid for every car and person near the drive, in every frame."""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S, Ego
from genre_tasks.logs.synthetic.layout import Layout
from genre_tasks.logs.types import CuboidTrack, Float64

_REACH_M = 80.0
_MOVING_M = 0.05


def annotate(layout: Layout, ego: Ego, frames: int, offset_m: Float64) -> tuple[CuboidTrack, ...]:
    """Tracks of everything that comes within 80 m; moving objects first."""
    times = np.arange(frames) * FRAME_S
    seen_from = ego.pose(times)[:, :3, 3]
    found = []
    for actor in layout.actors:
        found.append(_track(actor.name, actor.label, actor.world_SE3_actor(times), actor.size_m, seen_from, offset_m))
    for car in layout.parked:
        poses = np.broadcast_to(car.world_SE3_actor, (frames, 4, 4))
        found.append(_track(car.name, "Car", poses, car.size_m, seen_from, offset_m))
    return tuple(track for track in found if track is not None)


def _track(
    name: str,
    label: str,
    footprint: Float64,  # [F, 4, 4], origin on the ground
    size: tuple[float, float, float],
    seen_from: Float64,  # [F, 3]
    offset_m: Float64,
) -> CuboidTrack | None:
    near = np.flatnonzero(np.linalg.norm(footprint[:, :3, 3] - seen_from, axis=1) < _REACH_M)
    if len(near) == 0:
        return None
    boxes = footprint[near].copy()
    boxes[:, :3, 3] += boxes[:, :3, 2] * (size[2] / 2) + offset_m
    travel = float(np.linalg.norm(boxes[-1, :3, 3] - boxes[0, :3, 3]))
    return CuboidTrack(name, label, near.astype(np.int64), boxes, size, travel > _MOVING_M)
