"""Actors at moments between log frames, in the form in which the fixer looks poses up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Actor, Points

THIS_MOMENT = -1
LAST_MOMENT = -2
"""Frame numbers that stand for moments of a rollout; log frames are not negative."""


def pose_actors(
    actors: Sequence[Actor | ActorNode],
    moments: Mapping[int, float],
    recorded: Mapping[str, ActorNode] | None = None,
    frames: Sequence[int] = (),
) -> tuple[Actor, ...]:
    """Gives actors a pose under a number for each moment, beside their poses at log frames.

    The fixer finds an actor's pose by an integer frame. A moment between two frames gets a number of its own, and the
    pose that the renderer draws the actor at.

    Args:
        actors: A of a scene, as they drive in the rollout.
        moments: number → log frame, or moment between two.
        recorded: actors by track id as the images show them; an actor that is not among them is in no image. ``None``:
            ``actors`` are as recorded.
        frames: log frames at which images are looked up.

    Returns:
        A actors without points; where one does not exist it has no pose.

    >>> car = ActorNode("7", "car", (4.5, 1.8, 1.5), np.array([3]), np.eye(4)[None])
    >>> pose_actors([car], {-1: 3.25, -2: 9.0}, frames=[3])[0].frames.tolist()
    [-1, 3]
    """
    out = []
    for actor in actors:
        node = as_node(actor)
        shown = node if recorded is None else recorded.get(actor.track_id)
        poses = {number: node.pose(moment) for number, moment in moments.items()}
        if shown is not None:
            poses |= {frame: shown.pose(frame) for frame in frames}
        known = {number: pose for number, pose in poses.items() if pose is not None}
        stacked = np.stack(list(known.values())) if known else np.zeros((0, 4, 4))
        numbers = np.array(list(known), np.int64)
        out.append(Actor(actor.track_id, actor.label, actor.size_m, numbers, stacked, _NO_POINTS))
    return tuple(out)


def as_node(actor: Actor | ActorNode) -> ActorNode:
    """Takes an actor without its points.

    Args:
        actor: of a chunk or of a scene.

    Returns:
        Its box and path.
    """
    if isinstance(actor, ActorNode):
        return actor
    return ActorNode(actor.track_id, actor.label, actor.size_m, actor.frames, actor.chunk_SE3_box)


_NO_POINTS = Points(
    np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.bool_), np.zeros(0, np.int16)
)
