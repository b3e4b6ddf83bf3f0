"""The recorded path of a run: the ego poses of its chunks, one after the other."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence

import numpy as np

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.scene.chunk import Chunk

DEFAULT_FRAME_S = 0.1
"""Seconds of a log frame where a log has one frame only: most public logs are of 10 Hz."""


def join_recorded_path(chunks: Sequence[Chunk]) -> EgoPath:
    """Joins the recorded ego poses of chunks that follow each other.

    Args:
        chunks: in the order of the log.

    Returns:
        One pose for each log frame.
    """
    frames = np.concatenate([np.asarray(chunk.frames, np.float64) for chunk in chunks])
    poses = np.concatenate([chunk.world_SE3_chunk @ chunk.chunk_SE3_ego for chunk in chunks])
    frame_s = measure_frame_s(chunks)
    return EgoPath(times_s=(frames - frames[0]) * frame_s, frames=frames, world_SE3_ego=poses)


def measure_frame_s(chunks: Sequence[Chunk]) -> float:
    """Measures how long a log frame lasts, by the times of the images.

    Args:
        chunks: of one log.

    Returns:
        Seconds, the median over cameras and frames; ``DEFAULT_FRAME_S`` without two images of one camera, or where the
        log's clock stands or runs backwards.

    >>> measure_frame_s(())
    0.1
    """
    times_by_camera: dict[str, list[tuple[int, float]]] = {}
    for chunk in chunks:
        for view in chunk.views:
            times_by_camera.setdefault(view.camera, []).append((view.frame, view.timestamp_s))
    steps = []
    for times in times_by_camera.values():
        times.sort()
        # Divided by the frames between them, since images may be missing.
        steps += [(t1 - t0) / (f1 - f0) for (f0, t0), (f1, t1) in itertools.pairwise(times) if f1 > f0]
    frame_s = statistics.median(steps) if steps else 0.0
    return frame_s if frame_s > 0 else DEFAULT_FRAME_S
