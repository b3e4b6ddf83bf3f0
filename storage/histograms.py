"""Histograms as one line of text."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BARS = "▁▂▃▄▅▆▇█"
BINS = 12


def draw_histogram(values: NDArray[np.float64], bins: int = BINS) -> str:
    """Draws how values are spread between their smallest and their largest.

    Args:
        values: [N]; those that are not finite are left out.
        bins: number of equal parts, each a character.

    Returns:
        A blank for a part without any value, else a bar from ▁ to █ that is proportional to the count; empty where all
        values are the same, or none is finite.

    >>> draw_histogram(np.array([0.0, 0.1, 0.1, 0.2, 0.9]), bins=3)
    '█ ▂'
    """
    finite = values[np.isfinite(values)]
    if not len(finite) or finite.min() == finite.max():
        return ""
    # Halved, because the difference of the largest doubles would overflow.
    low = finite.min() / 2
    high = finite.max() / 2
    counts, _ = np.histogram((finite / 2 - low) / (high - low), bins=bins, range=(0.0, 1.0))
    # Rounded up: a single value among millions shows.
    levels = np.ceil(counts / counts.max() * len(_BARS)).astype(int)
    return "".join(" " if level == 0 else _BARS[level - 1] for level in levels)
