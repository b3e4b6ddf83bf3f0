"""Rigid actors: vehicles that move while the log is recorded."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.types import Effect, Measured


def measure(seen: Seen) -> Measured:
    """The longest way of an actor over the chunk; ingest leaves out those with too few points or frames."""
    ways = [_way(actor.chunk_SE3_box[:, :3, 3]) for actor in seen.chunk.actors]
    return Measured(max(ways, default=0.0), f"{len(ways)} tracks with LiDAR points")


def _way(centres: np.ndarray) -> float:
    """The largest distance from where it was first."""
    return float(np.linalg.norm(centres - centres[:1], axis=1).max(initial=0.0))


EFFECT = Effect("rigid_actors", "way of a cuboid track over the chunk", "m", 0.5, "a node and its Gaussians", measure)
