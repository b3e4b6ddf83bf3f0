"""Absolute times of a run and its log frames: which frame a simulator's time is at, by the times of the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from genre_tasks.ego_paths.recorded_path import DEFAULT_FRAME_S
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk

_PAST_THE_ENDS = 0.49
"""Log frames before the first and after the last image for which the nearest frame still is one of the run."""


@dataclass(frozen=True)
class RunClock:
    """Times of a run's log frames.

    Attributes:
        frames: [F] log frames, rising.
        times_s: [F] the mean time of the images of each frame, rising.
        camera_times_s: [F] the same of each camera, by its name.
    """

    frames: Float64
    times_s: Float64
    camera_times_s: Mapping[str, Float64]

    @property
    def frame_s(self) -> float:
        """Seconds of a log frame, the median."""
        if len(self.frames) < 2:
            return DEFAULT_FRAME_S
        return float(np.median(np.diff(self.times_s) / np.diff(self.frames)))

    @property
    def range_s(self) -> tuple[float, float]:
        """The time of the first image and of the last one."""
        times = [self.times_s, *self.camera_times_s.values()]
        return float(min(t[0] for t in times)), float(max(t[-1] for t in times))

    def find_time(self, frame: float) -> float:
        """Finds the mean time of a log frame's images.

        Args:
            frame: log frame of the run, or a moment between two.

        Returns:
            Absolute seconds.
        """
        start_s = self.times_s[0]
        return float(np.interp(frame, self.frames, self.times_s - start_s) + start_s)

    def find_frame(self, time_s: float, camera: str | None = None) -> float:
        """Finds the log frame of a time.

        Args:
            time_s: seconds, absolute.
            camera: whose images' times count; ``None``: the mean over all cameras.

        Returns:
            A log frame, or a moment between two; at most half a frame before the first or after the last.
        """
        times = self.times_s if camera is None else self.camera_times_s[camera]
        # Relative to the first image: a double of seconds since 1970 is no finer than a quarter of a microsecond.
        frame = float(np.interp(time_s - times[0], times - times[0], self.frames))
        before = min(time_s - times[0], 0.0)
        after = max(time_s - times[-1], 0.0)
        past = (before + after) / self.frame_s
        return frame + min(max(past, -_PAST_THE_ENDS), _PAST_THE_ENDS)


def read_clock(chunks: Sequence[Chunk]) -> RunClock:
    """Reads the times of a run's images.

    Args:
        chunks: in the order of the log.

    Returns:
        The clock; where a camera has no image at a frame, its time is between those of its other images.

    Raises:
        InputError: the times do not rise from frame to frame.
    """
    # A frame that two chunks share counts once.
    frames = np.unique(np.concatenate([np.asarray(chunk.frames, np.float64) for chunk in chunks]))
    times: dict[str, dict[int, float]] = {}
    for chunk in chunks:
        for view in chunk.views:
            times.setdefault(view.camera, {})[view.frame] = view.timestamp_s
    if not times:
        raise InputError("the run has no images, so its times are not known", remedy="Choose another run.")
    by_camera = {camera: _fill_times(frames, known, chunks[0].log) for camera, known in times.items()}
    return RunClock(frames, np.mean(list(by_camera.values()), axis=0), by_camera)


def _fill_times(frames: Float64, known: Mapping[int, float], log: str) -> Float64:
    """[F] times of all frames; past the first and last image as many seconds on as a frame lasts there."""
    moments = np.array(sorted(known), np.float64)
    start_s = known[int(moments[0])]
    times = np.array([known[int(frame)] - start_s for frame in moments])
    if len(times) > 1 and np.diff(times).min() <= 0:
        row = int(np.argmin(np.diff(times))) + 1
        raise InputError(
            "the times of a camera's images do not rise", remedy="Correct the log.", log=log, frame=int(moments[row])
        )
    frame_s = float(np.median(np.diff(times) / np.diff(moments))) if len(times) > 1 else DEFAULT_FRAME_S
    past = np.minimum(frames - moments[0], 0.0) + np.maximum(frames - moments[-1], 0.0)
    return np.asarray(np.interp(frames, moments, times) + past * frame_s + start_s, np.float64)
