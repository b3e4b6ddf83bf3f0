"""Lists of frames as messages show them."""

from __future__ import annotations

from collections.abc import Iterable

# A log with a hole in every second frame would fill the screen.
_MAX_RUNS_LISTED = 8


def format_frames(frames: Iterable[int]) -> str:
    """Lists frames for a message, with runs of neighbours shortened.

    Args:
        frames: increasing frame numbers.

    Returns:
        The frames, at most eight runs of them.

    >>> format_frames([3, 28, 29, 30])
    '3, 28–30'
    """
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = int(frame)
        else:
            runs.append([int(frame), int(frame)])
    texts = [str(first) if first == last else f"{first}–{last}" for first, last in runs]
    suffix = ", …" if len(texts) > _MAX_RUNS_LISTED else ""
    return ", ".join(texts[:_MAX_RUNS_LISTED]) + suffix
