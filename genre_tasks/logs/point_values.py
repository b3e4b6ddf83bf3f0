"""Points of LiDAR files that lack a value: without a place they are left out, without intensity or time they stay."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.findings import Finding
from genre_tasks.logs.types import Float32, Float64

Numbers = TypeVar("Numbers", Float32, Float64)

_REMEDY = "The points keep their place. Copy the sweep again if it was complete."


def find_placed_points(points: Float32 | Float64, frame: int) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Finds the points that have a place; the others are of no use.

    Args:
        points: [N, 3] as the file has them.
        frame: log frame, for the finding.

    Returns:
        [N] whether x, y and z are finite; and the finding ``invalid_points``, if any point has to be left out.

    >>> find_placed_points(np.array([[0.0, 1.0, 2.0], [0.0, np.nan, 2.0]]), 3)[0].tolist()
    [True, False]
    """
    placed: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(points), axis=1)
    if placed.all():
        return placed, []
    count = int(np.count_nonzero(~placed))
    message = f"{count} points of sweep {frame} are not finite and left out"
    return placed, [Finding("invalid_points", "warning", message, numbers={"points": count}, frames=(frame,))]


def fill_intensities(values: Numbers, frame: int, column: str = "intensity") -> tuple[Numbers, list[Finding]]:
    """Puts 0 where a point has no intensity.

    Args:
        values: [N] as the file has them; NaN or infinite where one is missing.
        frame: log frame, for the finding.
        column: what the file calls them, for the finding.

    Returns:
        [N] finite values, the same array where none is missing; and the finding ``missing_intensity``, if any is.

    >>> fill_intensities(np.array([0.5, np.nan]), 3)[0].tolist()
    [0.5, 0.0]
    """
    finite = np.isfinite(values)
    if finite.all():
        return values, []
    return _fill(values, finite, 0.0), [_describe("missing_intensity", finite, frame, column, "0")]


def fill_point_times(
    values: Float64, frame_time: float, frame: int, column: str = "time_s"
) -> tuple[Float64, list[Finding]]:
    """Puts the frame's time where a point has none.

    Args:
        values: [N] times of points; NaN or infinite where one is missing.
        frame_time: of the frame, in the unit of the values. Where it is not finite, the median of the values counts,
            and 0 where there is none.
        frame: log frame, for the finding.
        column: what the file calls them, for the finding.

    Returns:
        [N] finite values, the same array where none is missing; and the finding ``missing_point_time``, if any is.

    >>> values, (finding,) = fill_point_times(np.array([7.25, np.nan]), 7.0, 3, "t")
    >>> values.tolist(), finding.message
    ([7.25, 7.0], "1 points of sweep 3 have no finite t, which counts as the frame's time")
    """
    finite = np.isfinite(values)
    if finite.all():
        return values, []
    if not math.isfinite(frame_time):
        frame_time = float(np.median(values[finite])) if finite.any() else 0.0
    finding = _describe("missing_point_time", finite, frame, column, "the frame's time")
    return _fill(values, finite, frame_time), [finding]


def _fill(values: Numbers, finite: NDArray[np.bool_], value: float) -> Numbers:
    # A copy: what was read of a file may be read-only.
    filled = values.copy()
    filled[~finite] = value
    return filled


def _describe(word: str, finite: NDArray[np.bool_], frame: int, column: str, value: str) -> Finding:
    count = int(np.count_nonzero(~finite))
    message = f"{count} points of sweep {frame} have no finite {column}, which counts as {value}"
    # With its frame, so that only the chunk that has the sweep repeats it; the check makes one finding of all frames.
    return Finding(word, "warning", message, _REMEDY, {"points": count}, frames=(frame,))
