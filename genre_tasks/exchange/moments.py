"""Moments of a scene as files state them: numbers of log frames, and times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from genre_tasks.logs.types import Float64

Frame = Annotated[int, Field(ge=-(2**31), lt=2**31)]
"""A number of a log frame; larger ones are damage, and would not fit into an array of whole numbers."""


def is_rising(times_s: Sequence[float] | Float64) -> bool:
    """Tells whether times are those of moments: finite, and each after the one before.

    Args:
        times_s: [F] seconds.

    >>> is_rising([0.0, 0.1]), is_rising([0.0, 0.0]), is_rising([])
    (True, False, True)
    """
    times = np.asarray(times_s, np.float64)
    return bool(np.isfinite(times).all() and (times[1:] > times[:-1]).all())
