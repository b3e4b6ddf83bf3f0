"""Whether the ego vehicle stands: one measure and one limit for ``genre check`` and the stage ``ingest``."""

from __future__ import annotations

import math

import numpy as np

from genre_tasks.logs.types import Float64

STANDSTILL_M = 0.1
"""An ego vehicle that travels less than this in a chunk stands still: there is no parallax."""


def measure_travel_m(positions: Float64) -> float:
    """Measures how far the ego vehicle gets away from where it is first.

    Args:
        positions: [F, 3] metres, of the frames of a chunk; NaN where a pose cannot be read.

    Returns:
        The largest distance from the first position; NaN where fewer than two of several can be read.

    >>> measure_travel_m(np.array([[0.0, 0, 0], [3, 4, 0], [1, 0, 0]]))
    5.0
    >>> measure_travel_m(np.array([[0.0, 0, 0], [np.nan, 0, 0]]))
    nan
    """
    known = positions[np.isfinite(positions).all(axis=1)]
    # They say nothing of motion. The last frame of a log may be a chunk of its own, and is where it is.
    if len(known) < min(2, len(positions)):
        return math.nan
    # From the first position and not along the path: the noise of poses would add up, and turning adds no parallax.
    return float(np.linalg.norm(known - known[0], axis=1).max())
