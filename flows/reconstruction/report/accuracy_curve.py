"""The plot of accuracy against seconds along the unrolled iterations, as coordinates for an inline SVG."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flows.reconstruction.report.axis_ticks import round_ticks
from flows.reconstruction.run_summary import ChunkSummary

LABELS = {"gnet": "GNet", "enet": "ENet"}

# The area of the axes in the SVG of 640 × 300; what is left and below holds the labels of the ticks.
_LEFT = 48.0
_RIGHT = 628.0
_TOP = 16.0
_BOTTOM = 256.0


@dataclass(frozen=True)
class Line:
    """The line of one stage.

    Attributes:
        name: the stage's name.
        label: the stage's name for readers.
        points: (x, y, tooltip) in the coordinates of the SVG.
    """

    name: str
    label: str
    points: tuple[tuple[float, float, str], ...]

    @property
    def path(self) -> str:
        """The points as an SVG polyline lists them.

        >>> Line("gnet", "GNet", ((48.0, 256.0, "start"), (60.5, 200.0, "end"))).path
        '48,256 60.5,200'
        """
        return " ".join(f"{x:g},{y:g}" for x, y, _ in self.points)


@dataclass(frozen=True)
class Curve:
    """The plot, in the coordinates of an SVG of 640 × 300.

    Attributes:
        lines: one line for each stage.
        x: (coordinate, label) of the ticks on the horizontal axis, seconds.
        y: (coordinate, label) of the ticks on the vertical axis, dB.
        words: the curve in a sentence, for who cannot see it.
    """

    lines: tuple[Line, ...]
    x: tuple[tuple[float, str], ...]
    y: tuple[tuple[float, str], ...]
    words: str = ""


def accuracy_curve(chunk: ChunkSummary) -> Curve | None:
    """Plots held-out PSNR against the seconds of iterations: GNet's line, and ENet's from where GNet's ended.

    Args:
        chunk: a chunk whose stages may have a ``curve``.

    Returns:
        The plot, or ``None`` with fewer than two points.
    """
    lines = _cumulative_lines(chunk)
    points = [point for _, line in lines for point in line]
    # A single point makes no line.
    if len(points) < 2:
        return None
    ticks_x = round_ticks(0.0, max(seconds for seconds, _ in points))
    ticks_y = round_ticks(min(psnr for _, psnr in points), max(psnr for _, psnr in points))

    def to_svg(seconds: float, psnr: float) -> tuple[float, float]:
        across = (seconds - ticks_x[0]) / (ticks_x[-1] - ticks_x[0])
        up = (psnr - ticks_y[0]) / (ticks_y[-1] - ticks_y[0])
        # A tenth of a pixel is enough; more digits would only make the page longer.
        return round(_LEFT + across * (_RIGHT - _LEFT), 1), round(_BOTTOM - up * (_BOTTOM - _TOP), 1)

    svg_lines = []
    for name, line in lines:
        label = LABELS[name]
        svg_points = tuple((*to_svg(s, psnr), f"{label}: {psnr:.2f} dB after {s:.1f} s") for s, psnr in line)
        svg_lines.append(Line(name, label, svg_points))
    labels_x = tuple((to_svg(seconds, ticks_y[0])[0], f"{seconds:g}") for seconds in ticks_x)
    labels_y = tuple((to_svg(ticks_x[0], psnr)[1], f"{psnr:g}") for psnr in ticks_y)
    return Curve(tuple(svg_lines), labels_x, labels_y, _describe(lines))


def _cumulative_lines(chunk: ChunkSummary) -> list[tuple[str, list[tuple[float, float]]]]:
    """(seconds, PSNR) by stage; a line begins where the one before ended, the first one at the initial scene."""
    initial = chunk.stage("initial")
    start = [(0.0, psnr) for _, psnr in initial.curve[-1:]] if initial else []
    lines = []
    for name in ("gnet", "enet"):
        stage = chunk.stage(name)
        curve = stage.curve if stage else ()
        points = [(seconds, psnr) for seconds, psnr in curve if math.isfinite(seconds) and math.isfinite(psnr)]
        if points:
            offset_s = start[-1][0] if start else 0.0
            # A stage that measured its own scene before the first iteration needs no point of the stage before.
            line = [point for point in start if points[0][0] > 0]
            line += [(seconds + offset_s, psnr) for seconds, psnr in points]
            lines.append((name, line))
            # The next stage begins with the scene that this one ended with.
            start = line[-1:]
    return lines


def _describe(lines: list[tuple[str, list[tuple[float, float]]]]) -> str:
    parts = []
    for name, line in lines:
        (start_s, start_db), (end_s, end_db) = line[0], line[-1]
        parts.append(
            f"{LABELS[name]} from {start_db:.2f} dB after {start_s:.1f} s to {end_db:.2f} dB after {end_s:.1f} s"
        )
    return "Held-out PSNR against seconds of iterations: " + "; ".join(parts)
