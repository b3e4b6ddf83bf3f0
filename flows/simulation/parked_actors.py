"""Parked vehicles of a run's log: they belong to the background of its scenes, so the log has to be asked for them."""

from __future__ import annotations

from flows.simulation.recorded_log import find_recorded_tracks
from flows.simulation.run_scenes import RunScenes
from genre_tasks.ego_paths.world_actors import WorldActor, list_parked_actors


def list_parked(recorded: RunScenes) -> tuple[WorldActor, ...]:
    """Lists the parked vehicles at a run's frames.

    Args:
        recorded: the run.

    Returns:
        The vehicles; none where the log is gone, or its boxes cannot be read.
    """
    tracks = find_recorded_tracks(recorded)
    if tracks is None:
        return ()
    # Those of the chunks as recorded: an actor that an edit has removed is not parked in its place.
    reconstructed = [recorded.load(number).chunk for number in recorded.chunk_numbers]
    return list_parked_actors(tracks, reconstructed)
