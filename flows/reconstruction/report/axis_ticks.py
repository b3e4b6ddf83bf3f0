"""Round numbers for the axes of a plot."""

from __future__ import annotations

import math


def round_ticks(low: float, high: float) -> list[float]:
    """Chooses about five round numbers that enclose a range.

    Args:
        low: the smallest value shown.
        high: the largest value shown.

    Returns:
        Ascending numbers at equal distances, the first at most ``low`` and the last at least ``high``.

    >>> round_ticks(17.1, 24.1)
    [16, 18, 20, 22, 24, 26]
    """
    # A flat curve would otherwise have ticks at a distance of 0.
    span = max(high - low, 1e-3)
    wanted_step = span / 4
    unit = 10 ** math.floor(math.log10(wanted_step))
    # The tolerances keep a step that fits exactly from being skipped for the error of its last bit.
    step = next(m * unit for m in (1, 2, 2.5, 5, 10) if m * unit >= wanted_step * 0.999)
    first = math.floor(low / step + 1e-9)
    last = math.ceil(high / step - 1e-9)
    return [round(k * step, 10) for k in range(first, max(last, first + 1) + 1)]
