"""The plot of accuracy against seconds along the unrolled iterations, as coordinates for an inline SVG."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flows.reconstruction.run_summary import ChunkSummary

LABELS = {"gnet": "GNet", "enet": "ENet"}


@dataclass(frozen=True)
class Line:
    """One stage's points: x and y in the SVG, and what to say of each."""

    name: str
    label: str
    points: tuple[tuple[float, float, str], ...]

    @property
    def path(self) -> str:
        """The points as SVG writes them."""
        return " ".join(f"{x:g},{y:g}" for x, y, _ in self.points)


@dataclass(frozen=True)
class Curve:
    """Lines, and ticks as (coordinate, label) on both axes, in an SVG of 640 × 300."""

    lines: tuple[Line, ...]
    x: tuple[tuple[float, str], ...]
    y: tuple[tuple[float, str], ...]


def accuracy_curve(chunk: ChunkSummary) -> Curve | None:
    """The plot of held-out PSNR against seconds of iterations: GNet, then ENet where GNet ended.

    ``None`` with fewer than two points. Coordinates are in an SVG of 640 × 300.
    """
    lines = _curve_lines(chunk)
    points = [p for _, line in lines for p in line]
    if len(points) < 2:
        return None
    ticks_x = _ticks(0.0, max(x for x, _ in points))
    ticks_y = _ticks(min(y for _, y in points), max(y for _, y in points))
    left, right, top, bottom = 48.0, 628.0, 16.0, 256.0

    def place(x: float, y: float) -> tuple[float, float]:
        across = (x - ticks_x[0]) / (ticks_x[-1] - ticks_x[0])
        up = (y - ticks_y[0]) / (ticks_y[-1] - ticks_y[0])
        return round(left + across * (right - left), 1), round(bottom - up * (bottom - top), 1)

    placed = []
    for name, line in lines:
        marks = tuple((*place(x, y), f"{LABELS[name]}: {y:.2f} dB after {x:.1f} s") for x, y in line)
        placed.append(Line(name, LABELS[name], marks))
    across = tuple((place(x, ticks_y[0])[0], f"{x:g}") for x in ticks_x)
    up = tuple((place(ticks_x[0], y)[1], f"{y:g}") for y in ticks_y)
    return Curve(tuple(placed), across, up)


def _curve_lines(chunk: ChunkSummary) -> list[tuple[str, list[tuple[float, float]]]]:
    """Lines in cumulative seconds; each begins where the one before ended, the first one at the initial scene."""
    initial = chunk.stage("initial")
    start = [(0.0, y) for _, y in initial.curve[-1:]] if initial else []
    lines = []
    for name in ("gnet", "enet"):
        stage = chunk.stage(name)
        points = [(x, y) for x, y in stage.curve if math.isfinite(x) and math.isfinite(y)] if stage else []
        if points:
            offset = start[-1][0] if start else 0.0
            line = [p for p in start if points[0][0] > 0] + [(x + offset, y) for x, y in points]
            lines.append((name, line))
            start = line[-1:]
    return lines


def _ticks(low: float, high: float) -> list[float]:
    """About five round numbers that enclose [low, high]."""
    span = max(high - low, 1e-3)
    raw = span / 4
    unit = 10 ** math.floor(math.log10(raw))
    step = next(m * unit for m in (1, 2, 2.5, 5, 10) if m * unit >= raw * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(k * step, 10) for k in range(first, max(last, first + 1) + 1)]
