"""Parked vehicles of a run's log: they belong to the background of its scenes, so the log has to be asked for them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from flows.simulation.run_scenes import RunScenes
from genre_tasks.config import IngestConfig
from genre_tasks.ego_paths.world_actors import WorldActor, list_parked_actors
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import CuboidTrack
from genre_tasks.scene.actor_track import cut_track_to_chunk
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.moving_actors import select_moving_actors

_LIMITS = ("min_actor_travel_m", "min_actor_frames")


def find_tracks(recorded: RunScenes) -> tuple[CuboidTrack, ...] | None:
    """Finds the annotated objects of a run's log.

    Args:
        recorded: the run.

    Returns:
        The objects; ``None`` where the log is gone or another one, as for a store that was copied from another machine,
        where this version refuses its URI, or where its boxes cannot be read, without which the run went on too.
    """
    try:
        return recorded.log.tracks()
    except (InputError, ConfigError):
        return None


def list_parked(recorded: RunScenes, chunks: Iterable[Chunk]) -> tuple[WorldActor, ...]:
    """Lists the parked vehicles at a run's frames.

    Args:
        recorded: the run.
        chunks: those of the run as recorded: an actor that an edit has removed is not parked in its place.

    Returns:
        The vehicles; none where :func:`find_tracks` finds nothing.
    """
    tracks = find_tracks(recorded)
    return () if tracks is None else list_parked_actors(tracks, chunks)


def warn_of_standing_actors(
    recorded: RunScenes, chunks: Iterable[Chunk], names: Mapping[str, str]
) -> dict[int, tuple[str, ...]]:
    """Finds chunks in which an edited actor stands still, and so belongs to the background that no edit changes.

    Whether an actor moves is decided for each chunk: a car that waits and then drives is an actor in the later one.

    Args:
        recorded: the run.
        chunks: those of the run as recorded.
        names: readable names of the actors that are edited, by track id.

    Returns:
        Warnings by the number of the chunk; none where :func:`find_tracks` finds nothing.
    """
    if not names:
        return {}
    edited = [track for track in find_tracks(recorded) or () if track.track_id in names]
    section = recorded.record["config"].get("ingest", {})
    # Of that section these alone, as another version may have written the rest.
    limits = IngestConfig.model_validate({name: section[name] for name in _LIMITS if name in section})
    warnings = {}
    for chunk in chunks:
        actors = {actor.track_id for actor in chunk.actors}
        standing = [t for t in edited if t.track_id not in actors and _stands_still(t, chunk, limits)]
        if standing:
            place = f"log {chunk.log}, chunk {chunk.index}"
            warnings[chunk.index] = tuple(_warn_of(track, names[track.track_id], place) for track in standing)
    return warnings


def _warn_of(track: CuboidTrack, name: str, place: str) -> str:
    return f"{place}: {name} (track {track.track_id}) stands still there, and edits leave it in the background"


def _stands_still(track: CuboidTrack, chunk: Chunk, limits: IngestConfig) -> bool:
    """Whether a track is in a chunk, and ingest left its points in the background."""
    if cut_track_to_chunk(track, chunk.frames, chunk.world_SE3_chunk)[0] is None:
        return False
    moving = select_moving_actors(
        [track], chunk.frames, chunk.world_SE3_chunk, limits.min_actor_travel_m, limits.min_actor_frames
    )
    # Points of what moves too briefly, or has too few of them, are in no part of the scene.
    return not moving.tracks and not moving.brief_tracks
