"""The log that a finished run was made of, opened again for what its scenes do not hold."""

from __future__ import annotations

import numpy as np

from flows.pipeline.log_cache import cached_log
from flows.simulation.run_scenes import RunScenes
from genre_tasks.errors import InputError
from genre_tasks.logs.types import CuboidTrack, DrivingLog
from genre_tasks.scene.chunk import Chunk

_SAME_POSE = 1e-3


def open_recorded_log(recorded: RunScenes) -> DrivingLog:
    """Opens the log of a run.

    Args:
        recorded: the run.

    Returns:
        The log.

    Raises:
        InputError: the log is gone, or another one is in its place.
    """
    log = cached_log(recorded.record["log"])
    if not _is_log_of(log, recorded.load(recorded.chunk_numbers[0]).chunk):
        remedy = "Put the run's log back, or run the one that is there now."
        raise InputError("another log is where the run's was", remedy=remedy, log=log.uri)
    return log


def find_recorded_log(recorded: RunScenes) -> DrivingLog | None:
    """Opens the log of a run, if it is still there.

    Args:
        recorded: the run.

    Returns:
        The log; ``None`` where it is gone, as for a store that was copied from another machine, or is another one.
    """
    try:
        return open_recorded_log(recorded)
    except InputError:
        return None


def find_recorded_tracks(recorded: RunScenes) -> tuple[CuboidTrack, ...] | None:
    """Finds the annotated objects of a run's log.

    Args:
        recorded: the run.

    Returns:
        The objects; ``None`` where the log is gone, or its boxes cannot be read, without which the run went on too.
    """
    log = find_recorded_log(recorded)
    try:
        return None if log is None else log.tracks()
    except InputError:
        return None


def _is_log_of(log: DrivingLog, chunk: Chunk) -> bool:
    frame = chunk.frames[-1]
    if log.name != chunk.log or frame >= log.frame_count:
        return False
    expected = chunk.world_SE3_chunk @ chunk.chunk_SE3_ego[-1]
    return bool(np.allclose(log.world_SE3_lidar(frame), expected, rtol=0, atol=_SAME_POSE))
