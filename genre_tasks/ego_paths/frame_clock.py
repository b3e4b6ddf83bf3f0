"""When the log frames of a run were recorded, and which frame a time is at: pauses of the recording count."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.recorded_path import DEFAULT_FRAME_S, ImageTime, list_image_times, measure_frame_times
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk

# Sums of seconds err in the last digit: frame 4 is not to become 3.999999999.
_FRAME_DIGITS = 6


@dataclass(frozen=True)
class FrameClock:
    """Times of a run's log frames.

    Attributes:
        frames: [F] log frames, rising.
        times_s: [F] seconds since the first frame, rising.

    >>> clock = FrameClock(np.array([0.0, 1.0, 2.0]), np.array([0.0, 0.1, 3.1]))
    >>> clock.find_times([1, 1.5, 2]).tolist(), clock.find_frames([0.05, 1.6]).tolist()
    ([0.1, 1.6, 3.1], [0.5, 1.5])
    """

    frames: Float64
    times_s: Float64

    @classmethod
    def from_path(cls, path: EgoPath) -> FrameClock:
        """Takes the times of a recorded path.

        Args:
            path: of the run; a frame that two of its chunks share counts once.
        """
        frames, first_rows = np.unique(path.frames, return_index=True)
        return cls(frames, path.times_s[first_rows])

    @cached_property
    def frame_s(self) -> float:
        """Seconds of a log frame, the median; 0.1 for a single frame."""
        if len(self.frames) < 2:
            return DEFAULT_FRAME_S
        return float(np.median(np.diff(self.times_s) / np.diff(self.frames)))

    def find_times(self, frames: NDArray[Any] | Sequence[float]) -> Float64:
        """Finds the times of log frames.

        Args:
            frames: [N] of the run, or moments between them.

        Returns:
            [N] seconds since the first frame; those of the ends for frames outside of the run.
        """
        return np.asarray(np.interp(frames, self.frames, self.times_s), np.float64)

    def find_frames(self, times_s: Float64 | Sequence[float]) -> Float64:
        """Finds the log frames of times.

        Args:
            times_s: [N] seconds since the first frame.

        Returns:
            [N] log frames, or moments between them; the first or the last frame for times outside of the run.
        """
        frames = np.asarray(np.interp(times_s, self.times_s, self.frames), np.float64)
        return np.round(frames, _FRAME_DIGITS)


def measure_clock(chunks: Iterable[Chunk]) -> FrameClock:
    """Measures the times of a run's frames by those of its images.

    Args:
        chunks: in the order of the log; each is let go before the next one is asked for.

    Returns:
        The clock of all their frames.
    """
    frames: set[int] = set()
    images: list[ImageTime] = []
    for chunk in chunks:
        frames.update(chunk.frames)
        images += list_image_times(chunk)
    rising = np.array(sorted(frames), np.float64)
    return FrameClock(rising, measure_frame_times(rising, images))
