"""Edits of a street's traffic: actors removed, moved, turned, retimed or copied.

An edit makes a layout of a layout, so edits chain. Nothing of the log itself imports this module: its images and its
digest stay what they are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from genre_tasks.errors import InputError
from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S, draw_drive
from genre_tasks.logs.synthetic.log import SyntheticStreet
from genre_tasks.logs.synthetic.road import Road
from genre_tasks.logs.synthetic.street_actors import Actor, PoseAt
from genre_tasks.logs.synthetic.street_layout import StreetLayout, build_layout
from genre_tasks.logs.types import Float64
from genre_tasks.suggestions import did_you_mean


def build_street_layout(log: SyntheticStreet) -> StreetLayout:
    """Builds the street of a log as it was recorded, to edit it.

    Args:
        log: the street.

    Returns:
        The layout; its actors have the track ids of the log as names.
    """
    road = Road(log.parameters.seed)
    return build_layout(log.parameters, road, draw_drive(log.parameters, road))


def find_actor(layout: StreetLayout, name: str) -> Actor:
    """Finds an actor that may move; parked cars are no actors.

    Args:
        layout: the street.
        name: the actor's track id.

    Returns:
        The actor.

    Raises:
        InputError: the street has no such actor.
    """
    for actor in layout.actors:
        if actor.name == name:
            return actor
    names = [actor.name for actor in layout.actors]
    known = f"It has {', '.join(names) or 'none'}."
    raise InputError(f"the street has no actor {name!r}", remedy=did_you_mean(name, names) + known)


def remove_actor(layout: StreetLayout, name: str) -> StreetLayout:
    """Takes an actor off the street, with its shadow.

    Args:
        layout: the street.
        name: the actor's track id.

    Raises:
        InputError: the street has no such actor.
    """
    removed = find_actor(layout, name)
    return replace(layout, actors=tuple(actor for actor in layout.actors if actor is not removed))


def set_motion(layout: StreetLayout, name: str, motion: PoseAt) -> StreetLayout:
    """Lets an actor move in another way; its limbs swing as before.

    Args:
        layout: the street.
        name: the actor's track id.
        motion: times [n] in seconds since the first frame → [n, 4, 4] street_SE3_actor.

    Raises:
        InputError: the street has no such actor.
    """
    changed = find_actor(layout, name)
    moved = replace(changed, street_SE3_actor=motion)
    return replace(layout, actors=tuple(moved if actor is changed else actor for actor in layout.actors))


def move_actor(layout: StreetLayout, name: str, actor_SE3_moved: Float64) -> StreetLayout:
    """Moves or turns an actor relative to where it was recorded, at all times by the same.

    Args:
        layout: the street.
        name: the actor's track id.
        actor_SE3_moved: [4, 4] from the actor's new frame to its recorded one: x forward, y left, z up, origin on the
            ground. A translation moves it along its own axes.

    Raises:
        InputError: the street has no such actor.
    """
    recorded = find_actor(layout, name).street_SE3_actor
    return set_motion(layout, name, lambda times: recorded(times) @ actor_SE3_moved)


def rotate_actor(layout: StreetLayout, name: str, yaw_rad: float) -> StreetLayout:
    """Turns an actor about its upright axis, through the middle of its footprint.

    Args:
        layout: the street.
        name: the actor's track id.
        yaw_rad: angle, to the left.

    Raises:
        InputError: the street has no such actor.
    """
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", yaw_rad).as_matrix()
    return move_actor(layout, name, turn)


def retime_actor(layout: StreetLayout, name: str, delay_s: float) -> StreetLayout:
    """Lets an actor do later what it did, limbs included.

    Args:
        layout: the street.
        name: the actor's track id.
        delay_s: seconds; negative: earlier.

    Raises:
        InputError: the street has no such actor.
    """
    return _change_clock(layout, name, factor=1.0, pivot_s=0.0, delay_s=delay_s)


def scale_actor_speed(layout: StreetLayout, name: str, factor: float, pivot_s: float = 0.0) -> StreetLayout:
    """Lets an actor follow its path faster or slower.

    Args:
        layout: the street.
        name: the actor's track id.
        factor: of its speed; 0: it stands.
        pivot_s: the time, in seconds since the first frame, at which the actor is where it was recorded.

    Raises:
        InputError: the street has no such actor.
    """
    return _change_clock(layout, name, factor=factor, pivot_s=pivot_s, delay_s=0.0)


def _change_clock(layout: StreetLayout, name: str, *, factor: float, pivot_s: float, delay_s: float) -> StreetLayout:
    changed = find_actor(layout, name)

    def with_clock(pose: PoseAt) -> PoseAt:
        return lambda times: pose(pivot_s + factor * (np.asarray(times, float) - delay_s - pivot_s))

    parts = tuple(
        part if part.actor_SE3_part is None else replace(part, actor_SE3_part=with_clock(part.actor_SE3_part))
        for part in changed.parts
    )
    moved = replace(changed, parts=parts, street_SE3_actor=with_clock(changed.street_SE3_actor))
    return replace(layout, actors=tuple(moved if actor is changed else actor for actor in layout.actors))


def insert_actor(layout: StreetLayout, actor: Actor, name: str, motion: PoseAt) -> StreetLayout:
    """Puts a copy of an actor on the street, of this street or of another one.

    Args:
        layout: the street.
        actor: what is copied.
        name: of the copy.
        motion: times [n] in seconds since the first frame → [n, 4, 4] street_SE3_actor.

    Raises:
        InputError: the street has an actor of that name already.
    """
    if any(other.name == name for other in layout.actors):
        raise InputError(f"the street has an actor {name!r} already", remedy="Choose another name for the copy.")
    return replace(layout, actors=(*layout.actors, replace(actor, name=name, street_SE3_actor=motion)))


def follow_boxes(
    moments: ArrayLike,  # [F]
    world_SE3_box: Float64,  # [F, 4, 4]
    height_m: float,
    offset_m: Float64,  # [3]
) -> PoseAt:
    """Makes a motion of an annotated box's poses, such as those of an edited scene's actor.

    Args:
        moments: [F] log frames, rising.
        world_SE3_box: [F, 4, 4] poses of the box, whose origin is its centre.
        height_m: of the box.
        offset_m: [3] of the log, from the street's coordinates to the world's.

    Returns:
        The motion: straight between two poses, and at rest before the first and after the last.

    Raises:
        InputError: there is no pose.
    """
    times = np.asarray(moments, np.float64) * FRAME_S
    if not len(times):
        raise InputError("a motion needs a pose, and there is none", remedy="Check the frames of the actor's boxes.")
    poses = np.array(world_SE3_box, np.float64)
    poses[:, :3, 3] -= offset_m + poses[:, :3, 2] * (height_m / 2)
    if len(times) == 1:
        return lambda asked: np.broadcast_to(poses[0], (len(np.atleast_1d(asked)), 4, 4)).copy()
    turns = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))

    def motion(asked: Any) -> Float64:
        within = np.clip(np.atleast_1d(np.asarray(asked, np.float64)), times[0], times[-1])
        out = np.tile(np.eye(4), (len(within), 1, 1))
        out[:, :3, :3] = turns(within).as_matrix()
        for axis in range(3):
            out[:, axis, 3] = np.interp(within, times, poses[:, axis, 3])
        return out

    return motion
