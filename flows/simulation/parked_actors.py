"""Parked vehicles of a run's log: they belong to the background of its scenes, so the log has to be asked for them."""

from __future__ import annotations

from flows.simulation.run_scenes import RunScenes
from genre_tasks.ego_paths.world_actors import WorldActor, list_parked_actors
from genre_tasks.errors import InputError
from genre_tasks.logs.types import CuboidTrack


def find_tracks(recorded: RunScenes) -> tuple[CuboidTrack, ...] | None:
    """Finds the annotated objects of a run's log.

    Args:
        recorded: the run.

    Returns:
        The objects; ``None`` where the log is gone or another one, as for a store that was copied from another machine,
        or its boxes cannot be read, without which the run went on too.
    """
    try:
        return recorded.log.tracks()
    except InputError:
        return None


def list_parked(recorded: RunScenes) -> tuple[WorldActor, ...]:
    """Lists the parked vehicles at a run's frames.

    Args:
        recorded: the run.

    Returns:
        The vehicles; none where :func:`find_tracks` finds nothing.
    """
    tracks = find_tracks(recorded)
    if tracks is None:
        return ()
    # Those of the chunks as recorded: an actor that an edit has removed is not parked in its place.
    reconstructed = [recorded.load(number).chunk for number in recorded.chunk_numbers]
    return list_parked_actors(tracks, reconstructed)
