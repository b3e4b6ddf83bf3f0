"""Chunks without images and points, for what reads the tracks and poses of all chunks of a run at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from genre_tasks.scene.chunk import Chunk, Points
from genre_tasks.scene_edits.chunk_scene import SceneSource

_NO_POINTS = Points(
    np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.bool_), np.zeros(0, np.int16)
)


def drop_measurements(chunk: Chunk) -> Chunk:
    """Leaves out a chunk's images and points, which are most of its memory.

    Args:
        chunk: any chunk.

    Returns:
        The chunk with its poses, lenses, times and tracks.
    """
    views = tuple(replace(view, image=b"") for view in chunk.views)
    actors = tuple(replace(actor, points=_NO_POINTS) for actor in chunk.actors)
    return replace(chunk, views=views, actors=actors, static=_NO_POINTS)


def load_outlines(source: SceneSource) -> list[Chunk]:
    """Reads all chunks of a run, of which no scene, image or point stays in memory.

    Args:
        source: the scenes of a run.

    Returns:
        The chunks in the order of the log, as :func:`drop_measurements` leaves them.
    """
    # Every chunk once, in order: a source keeps only the last few in memory.
    return [drop_measurements(source.load(number).chunk) for number in source.chunk_numbers]
