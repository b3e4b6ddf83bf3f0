"""Annotations: a cuboid for every car and person near the drive, in every frame."""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S, EgoDrive
from genre_tasks.logs.synthetic.street_actors import Actor
from genre_tasks.logs.synthetic.street_layout import ParkedCar, StreetLayout
from genre_tasks.logs.types import CuboidTrack, Float64

# Beyond that an object is a few pixels wide and has next to no LiDAR points.
_MAX_DISTANCE_M = 80.0
# Who stands moves by rounding alone.
_MOVING_M = 0.05


def annotate_actors(layout: StreetLayout, ego: EgoDrive, frames: int, offset_m: Float64) -> tuple[CuboidTrack, ...]:
    """Annotates everything that comes within 80 m of the ego vehicle.

    Args:
        layout: the street.
        ego: how the ego vehicle drives.
        frames: of the log.
        offset_m: [3] added to the street's coordinates to get the world's.

    Returns:
        The tracks, those of ``layout.actors`` first.
    """
    times = np.arange(frames) * FRAME_S
    ego_positions = ego.pose(times)[:, :3, 3]
    tracks: list[CuboidTrack | None] = []
    for actor in layout.actors:
        tracks.append(_build_track(actor, actor.street_SE3_actor(times), ego_positions, offset_m))
    for car in layout.parked:
        # Parked cars are annotated too, as in real logs; only ``moving`` tells them apart.
        poses = np.broadcast_to(car.street_SE3_actor, (frames, 4, 4))
        tracks.append(_build_track(car, poses, ego_positions, offset_m))
    return tuple(track for track in tracks if track is not None)


def _build_track(
    actor: Actor | ParkedCar,
    street_SE3_actor: Float64,  # [F, 4, 4], origin on the ground
    ego_positions: Float64,  # [F, 3]
    offset_m: Float64,  # [3]
) -> CuboidTrack | None:
    """The track of one actor, in the frames in which it is near; ``None`` if there are none."""
    distances = np.linalg.norm(street_SE3_actor[:, :3, 3] - ego_positions, axis=1)
    near = np.flatnonzero(distances < _MAX_DISTANCE_M)
    if len(near) == 0:
        return None
    boxes = street_SE3_actor[near].copy()
    # From the ground to the box's centre, along the actor's own up, and into the world.
    boxes[:, :3, 3] += boxes[:, :3, 2] * (actor.size_m[2] / 2) + offset_m
    travel = float(np.linalg.norm(boxes[-1, :3, 3] - boxes[0, :3, 3]))
    return CuboidTrack(
        track_id=actor.name,
        label=actor.label,
        frames=near.astype(np.int64),
        world_SE3_box=boxes,
        size_m=actor.size_m,
        moving=travel > _MOVING_M,
    )
