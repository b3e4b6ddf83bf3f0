"""Parked vehicles of a run's log: they belong to the background of its scenes, so the log has to be asked for them."""

from __future__ import annotations

from flows.pipeline.log_cache import cached_log
from flows.simulation.run_scenes import RunScenes
from genre_tasks.ego_paths.world_actors import WorldActor, list_parked_actors
from genre_tasks.errors import InputError
from genre_tasks.logs.types import CuboidTrack, DrivingLog


def find_log(uri: str) -> DrivingLog | None:
    """Opens the log of a run, if it is still there.

    Args:
        uri: of the log.

    Returns:
        The log; ``None`` where it is gone, as for a store that was copied from another machine.
    """
    try:
        return cached_log(uri)
    except InputError:
        return None


def find_tracks(uri: str) -> tuple[CuboidTrack, ...] | None:
    """Finds the annotated objects of a run's log.

    Args:
        uri: of the log.

    Returns:
        The objects; ``None`` where the log is gone, or its boxes cannot be read, without which the run went on too.
    """
    log = find_log(uri)
    try:
        return None if log is None else log.tracks()
    except InputError:
        return None


def list_parked(recorded: RunScenes) -> tuple[WorldActor, ...]:
    """Lists the parked vehicles at a run's frames.

    Args:
        recorded: the run.

    Returns:
        The vehicles; none where the log is gone, or its boxes cannot be read.
    """
    tracks = find_tracks(recorded.record["log"])
    if tracks is None:
        return ()
    # Those of the chunks as recorded: an actor that an edit has removed is not parked in its place.
    reconstructed = [recorded.load(number).chunk for number in recorded.chunk_numbers]
    return list_parked_actors(tracks, reconstructed)
