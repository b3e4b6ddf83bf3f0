"""Things that are annotated and may move: cars and pedestrians.

An actor's frame has its origin at the middle of its footprint on the ground: x forward, y left, z up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from genre_tasks.logs.synthetic.mesh import Mesh
from genre_tasks.logs.types import Float64

# A function of time, not poses per frame: LiDAR beams and shutter rows have times of their own.
# A pose as a function of time: [n] seconds since the first frame → [n, 4, 4].
PoseAt = Callable[[Any], Float64]


@dataclass(frozen=True)
class Part:
    """A rigid piece of an actor.

    Attributes:
        mesh: in the part's own frame.
        actor_SE3_part: where the part is at a time; ``None``: its frame is the actor's.
    """

    mesh: Mesh
    actor_SE3_part: PoseAt | None = None


@dataclass(frozen=True)
class Actor:
    """Something annotated that may move.

    Attributes:
        name: unique in the log; the track's id.
        label: class of its annotation.
        parts: rigid pieces, which move against each other.
        size_m: length, width, height of its box.
        street_SE3_actor: where the actor is at a time, in the street's own coordinates.
    """

    name: str
    label: str
    parts: tuple[Part, ...]
    size_m: tuple[float, float, float]
    street_SE3_actor: PoseAt
