"""Objects of a log that renders do not show, since no scene of the chunk has them."""

from __future__ import annotations

from collections.abc import Sequence

from genre_tasks.config import IngestConfig
from genre_tasks.logs.types import CuboidTrack
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.moving_actors import select_moving_actors


def find_absent_objects(tracks: Sequence[CuboidTrack], chunk: Chunk, config: IngestConfig) -> frozenset[str]:
    """Finds the moving objects that a chunk has no actor for: they were seen too briefly, or by too few LiDAR points.

    Args:
        tracks: of the chunk's log.
        chunk: with its plan's effects applied.
        config: that the chunk was made with.

    Returns:
        Their ids; what stands still belongs to the background, and is not among them.
    """
    least = config.min_actor_travel_m, config.min_actor_frames
    moving = select_moving_actors(tracks, chunk.frames, chunk.world_SE3_chunk, *least)
    found = {track.track_id for track in (*moving.tracks, *moving.brief_tracks)}
    return frozenset(found - {actor.track_id for actor in chunk.actors})
