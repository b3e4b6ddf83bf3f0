"""The recorded path of a run: the ego poses of its chunks, one after the other."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk

DEFAULT_FRAME_S = 0.1
"""Seconds of a log frame where a log has one frame only: most public logs are of 10 Hz."""


# Clocks of logs round their times and jitter, which a path of even steps smooths. What is further off is a pause, or
# frames that were dropped.
_MAX_UNEVEN = 1.5


class ImageTime(NamedTuple):
    """When an image was taken.

    Attributes:
        camera: its name.
        frame: of the log.
        time_s: seconds on the log's clock.
    """

    camera: str
    frame: int
    time_s: float


def list_image_times(chunk: Chunk) -> list[ImageTime]:
    """Lists when the images of a chunk were taken.

    Args:
        chunk: of a log.
    """
    return [ImageTime(view.camera, view.frame, view.timestamp_s) for view in chunk.views]


def join_recorded_path(chunks: Sequence[Chunk]) -> EgoPath:
    """Joins the recorded ego poses of chunks that follow each other.

    Args:
        chunks: in the order of the log.

    Returns:
        One pose for each log frame.
    """
    frames = np.concatenate([np.asarray(chunk.frames, np.float64) for chunk in chunks])
    poses = np.concatenate([chunk.world_SE3_chunk @ chunk.chunk_SE3_ego for chunk in chunks])
    images = [image for chunk in chunks for image in list_image_times(chunk)]
    return EgoPath(times_s=measure_frame_times(frames, images), frames=frames, world_SE3_ego=poses)


def measure_frame_times(frames: Sequence[int] | Float64, images: Iterable[ImageTime]) -> Float64:
    """Measures when log frames were recorded: at even steps, but for pauses of the recording.

    Args:
        frames: [F] of one log, rising.
        images: of these frames.

    Returns:
        [F] seconds since the first frame.

    >>> images = [ImageTime("front", frame, time_s) for frame, time_s in enumerate([5.0, 5.1, 5.19, 7.2, 7.3])]
    >>> measure_frame_times(range(5), images).round(3).tolist()
    [0.0, 0.1, 0.2, 2.21, 2.31]
    """
    times = _group_by_camera(images)
    frame_s = _find_median_step(times)
    moments = np.asarray(frames, np.float64)
    pauses_s = np.zeros(len(moments))
    for index, (before, after) in enumerate(itertools.pairwise(int(frame) for frame in frames), start=1):
        even = (after - before) * frame_s
        steps = [taken[after] - taken[before] for taken in times.values() if before in taken and after in taken]
        measured = statistics.fmean(steps) if steps else even
        # A clock that stands or runs backwards tells nothing.
        if measured > 0 and not even / _MAX_UNEVEN <= measured <= even * _MAX_UNEVEN:
            pauses_s[index] = measured - even
    return (moments - moments[:1]) * frame_s + np.cumsum(pauses_s)


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
    return _find_median_step(_group_by_camera(image for chunk in chunks for image in list_image_times(chunk)))


def _group_by_camera(images: Iterable[ImageTime]) -> dict[str, dict[int, float]]:
    """Times by camera and frame."""
    times: dict[str, dict[int, float]] = {}
    for image in images:
        times.setdefault(image.camera, {})[image.frame] = image.time_s
    return times


def _find_median_step(times: dict[str, dict[int, float]]) -> float:
    steps = []
    for taken in times.values():
        # Divided by the frames between them, since images may be missing.
        steps += [(taken[f1] - taken[f0]) / (f1 - f0) for f0, f1 in itertools.pairwise(sorted(taken))]
    frame_s = statistics.median(steps) if steps else 0.0
    return frame_s if frame_s > 0 else DEFAULT_FRAME_S
