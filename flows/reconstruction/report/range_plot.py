"""The plot of a reliable range: estimated PSNR over metres to the side, as coordinates for an inline SVG."""

from __future__ import annotations

from dataclasses import dataclass

from flows.reconstruction.report.axis_ticks import round_ticks
from flows.reconstruction.run_summary import RangeSummary

# The area of the axes in the SVG of 640 × 260; what is left and below holds the labels of the ticks.
_LEFT = 48.0
_RIGHT = 628.0
_TOP = 16.0
_BOTTOM = 216.0


@dataclass(frozen=True)
class RangePlot:
    """The plot, in the coordinates of an SVG of 640 × 260; the left of the path is on the left.

    Attributes:
        words: the range in a sentence.
        path: the curve's points, as an SVG polyline lists them.
        points: (x, y, tooltip, whether all guards hold).
        band: left and right end of where the scene can be trusted.
        limit_y: height of the line below which a shift does not hold.
        x: (coordinate, label) of the ticks on the horizontal axis, metres.
        y: (coordinate, label) of the ticks on the vertical axis, dB.
    """

    words: str
    path: str
    points: tuple[tuple[float, float, str, bool], ...]
    band: tuple[float, float]
    limit_y: float
    x: tuple[tuple[float, str], ...]
    y: tuple[tuple[float, str], ...]


def describe_range(found: RangeSummary) -> str:
    """Says how far a scene can be trusted.

    Args:
        found: the range.

    Returns:
        A phrase such as ``2.3 m to the left, 5.0 m or more to the right``.

    >>> describe_range(RangeSummary("enet", left_m=2.3, right_m=5.0, farthest_m=5.0))
    '2.3 m to the left, 5.0 m or more to the right'
    """
    left, right = (
        f"{metres:.1f} m{' or more' if metres >= found.farthest_m else ''}" for metres in (found.left_m, found.right_m)
    )
    return f"{left} to the left, {right} to the right"


def plot_range_curve(found: RangeSummary) -> RangePlot | None:
    """Places the curve of a reliable range.

    Args:
        found: the range.

    Returns:
        The plot, or ``None`` where only the metres are known.
    """
    if len(found.points) < 2 or found.limit_db is None:
        return None
    estimates = [db for _, db, _ in found.points]
    ticks_y = round_ticks(min(*estimates, found.limit_db), max(*estimates, found.limit_db))
    ticks_x = round_ticks(min(shift for shift, *_ in found.points), max(shift for shift, *_ in found.points))

    def place_x(shift_m: float) -> float:
        across = (shift_m - ticks_x[0]) / (ticks_x[-1] - ticks_x[0])
        # Left of the path is positive, and it belongs on the left of the plot.
        return round(_RIGHT - across * (_RIGHT - _LEFT), 1)

    def place_y(db: float) -> float:
        return round(_BOTTOM - (db - ticks_y[0]) / (ticks_y[-1] - ticks_y[0]) * (_BOTTOM - _TOP), 1)

    points = tuple(
        (
            place_x(shift),
            place_y(db),
            f"{_name_shift(shift)}: {db:.1f} dB, {'holds' if holds else 'does not hold'}",
            holds,
        )
        for shift, db, holds in found.points
    )
    return RangePlot(
        words=f"Estimated PSNR beside the path; the scene can be trusted {describe_range(found)}",
        path=" ".join(f"{x:g},{y:g}" for x, y, _, _ in points),
        points=points,
        band=(place_x(found.left_m), place_x(-found.right_m)),
        limit_y=place_y(found.limit_db),
        x=tuple((place_x(shift), f"{shift:g}".replace("-", "−")) for shift in ticks_x),
        y=tuple((place_y(db), f"{db:g}") for db in ticks_y),
    )


def _name_shift(shift_m: float) -> str:
    if shift_m == 0:
        return "on the path"
    return f"{abs(shift_m):g} m to the {'left' if shift_m > 0 else 'right'}"
