"""Small histograms of one number over all logs, as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from flows.reconstruction.report.axis_ticks import round_ticks

WIDTH = 300
"""Of the drawing, in its units."""

HEIGHT = 130
"""Of the drawing, in its units."""

_BINS = 20
_LEFT = 8.0
_RIGHT = WIDTH - 8.0
_TOP = 8.0
_BOTTOM = HEIGHT - 22.0


@dataclass(frozen=True)
class Bar:
    """One bar.

    Attributes:
        x: left edge, in units of the drawing.
        y: top edge.
        width: of the bar.
        height: of the bar.
        words: the interval and how many logs are in it.
    """

    x: float
    y: float
    width: float
    height: float
    words: str


@dataclass(frozen=True)
class Histogram:
    """How a number is distributed over the logs.

    Attributes:
        title: what the number is.
        summary: smallest value, median and largest value.
        bars: from the left to the right; empty bins have none.
        ticks: (x, label) of the axis.
        median_x: position of the median.
    """

    title: str
    summary: str
    bars: tuple[Bar, ...]
    ticks: tuple[tuple[float, str], ...]
    median_x: float


def draw_histogram(title: str, values: Sequence[float], decimals: int) -> Histogram | None:
    """Draws the distribution of a number.

    Args:
        title: what the number is.
        values: of the logs; those that are not finite are left out.
        decimals: digits after the point.

    Returns:
        The drawing, or ``None`` where all finite values are equal, or there are none.

    >>> draw_histogram("PSNR, dB", [20.0, 21.0, 30.0], 1).summary
    '20.0 … 21.0 … 30.0'
    """
    finite = sorted(value for value in values if math.isfinite(value))
    if not finite or finite[0] == finite[-1]:
        return None
    ends = round_ticks(finite[0], finite[-1])
    low = ends[0]
    high = ends[-1]
    counts = [0] * _BINS
    for value in finite:
        counts[min(_BINS - 1, int((value - low) / (high - low) * _BINS))] += 1
    step = (high - low) / _BINS
    width = (_RIGHT - _LEFT) / _BINS
    bars = []
    for position, count in enumerate(counts):
        if not count:
            continue
        height = max(2.0, count / max(counts) * (_BOTTOM - _TOP))
        start = low + position * step
        words = f"{start:.{decimals}f} to {start + step:.{decimals}f}: {count}"
        bars.append(Bar(_LEFT + position * width + 0.5, _BOTTOM - height, width - 1, height, words))
    middle = finite[len(finite) // 2] if len(finite) % 2 else sum(finite[len(finite) // 2 - 1 :][:2]) / 2
    shown = " … ".join(f"{value:.{decimals}f}" for value in (finite[0], middle, finite[-1]))
    return Histogram(
        title=title,
        summary=shown.replace("-", "−"),
        bars=tuple(bars),
        # More labels than three would run into each other on a phone.
        ticks=tuple((_place(end, low, high), f"{end:g}".replace("-", "−")) for end in (low, (low + high) / 2, high)),
        median_x=_place(middle, low, high),
    )


def _place(value: float, low: float, high: float) -> float:
    return round(_LEFT + (value - low) / (high - low) * (_RIGHT - _LEFT), 1)
