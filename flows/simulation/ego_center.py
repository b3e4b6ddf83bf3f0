"""Where the middle of the ego vehicle is, which boxes of collisions and simulators are placed by."""

from __future__ import annotations

from flows.simulation.run_scenes import RunScenes
from genre_tasks.errors import InputError
from genre_tasks.logs.vehicle_center import find_center_ahead


def find_ego_center(recorded: RunScenes) -> float:
    """Finds how far ahead of a run's ego poses the middle of the vehicle is.

    Args:
        recorded: the run.

    Returns:
        Metres; 0 where the log is gone or another one, since scenes do not hold it.
    """
    try:
        return find_center_ahead(recorded.log)
    except InputError:
        return 0.0
