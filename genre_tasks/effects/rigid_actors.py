"""Rigid actors: vehicles that move while the log is recorded get Gaussians of their own, which move with their box."""

from __future__ import annotations

import numpy as np

from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.types import Effect, Measurement
from genre_tasks.logs.types import Float64


def measure(measurements: ChunkMeasurements) -> Measurement:
    """Measures how far an actor travels over the chunk, at most.

    Args:
        measurements: the chunk's actors; ``ingest`` leaves out those with too few points or frames.

    Returns:
        Metres, of the actor that travels farthest; 0 without actors.
    """
    travels = [travel_m(actor.chunk_SE3_box[:, :3, 3]) for actor in measurements.chunk.actors]
    return Measurement(max(travels, default=0.0), f"{len(travels)} tracks with LiDAR points")


def travel_m(centers: Float64) -> float:
    """Computes how far a track gets away from where it began.

    Args:
        centers: [F, 3] metres, the box's centre at each frame.

    Returns:
        The largest distance from the first centre; 0 for no frame.

    >>> travel_m(np.array([[0.0, 0, 0], [3, 4, 0], [1, 0, 0]]))
    5.0
    """
    # From the first centre and not along the track: the noise of annotations would add up to metres.
    return float(np.linalg.norm(centers - centers[:1], axis=1).max(initial=0.0))


EFFECT = Effect(
    name="rigid_actors",
    property="way of a cuboid track over the chunk",
    unit="m",
    threshold=0.5,
    cost="a node and its Gaussians",
    measure=measure,
)
