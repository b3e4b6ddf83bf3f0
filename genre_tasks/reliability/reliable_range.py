"""The reliable range: how far to each side of the path the guards hold."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from genre_tasks.config import RangeConfig
from genre_tasks.effects.apply_plan import applied
from genre_tasks.effects.types import UNPLANNED, EffectsPlan
from genre_tasks.fixer.source_images import recorded
from genre_tasks.progress import Progress, silent
from genre_tasks.reliability.guards import Guards, guards_of
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_poses import novel_view_poses
from genre_tasks.scene.novel_views import NovelViews
from genre_tasks.stages.novel_views import render_novel

if TYPE_CHECKING:
    from genre_tasks.reliability.detector import Detector


@dataclass(frozen=True)
class CurvePoint:
    """At one shift (metres, left is positive): medians over the views, and whether they are within the limits.

    ``detected``: the share of all views' actors that a detector finds; NaN without one, or without actors.
    """

    shift_m: float
    views: int
    estimate_db: float
    agreement_db: float
    shown: float
    thin: float
    floating: float
    holds: bool
    detected: float = math.nan


@dataclass(frozen=True)
class ReliableRange:
    """``left_m`` and ``right_m``: how far all points hold, between two shifts where the first limit is crossed.

    ``points`` by shift, from the right to the left, 0 among them. ``guards`` of all views.
    """

    points: tuple[CurvePoint, ...]
    guards: tuple[Guards, ...]
    left_m: float
    right_m: float
    limits: RangeConfig

    def __str__(self) -> str:
        most = max(self.limits.shifts_m)
        left, right = (f"{m:.1f} m{' or more' if m >= most else ''}" for m in (self.left_m, self.right_m))
        return f"usable to {left} left, {right} right"


def reliable_range(
    config: RangeConfig,
    chunk: Chunk,
    scene: SceneGraph,
    plan: EffectsPlan = UNPLANNED,
    progress: Progress = silent,
    detector: Detector | None = None,
) -> ReliableRange:
    """The scene rendered at every ``config.every``-th frame of the path and beside it, and its guards.

    Limits are relative to the path itself: what no image shows there (sky above, what the rig hides) is no fault of the
    shift. ``detector``: of road users; how many it finds is a guard, too. Raises ``InputError`` for an image of the
    chunk that cannot be decoded.
    """
    found = [g for _, guards in measured(config, applied(chunk, plan), scene, progress, detector) for g in guards]
    return judged(found, config)


def measured(
    config: RangeConfig, chunk: Chunk, scene: SceneGraph, progress: Progress, detector: Detector | None = None
) -> Iterator[tuple[NovelViews, list[Guards]]]:
    """For each shift, 0 first, the renders and their guards; ``chunk`` has its plan's effects applied."""
    frames = chunk.frames[config.every // 2 :: config.every] or chunk.frames[:1]
    shifts = [0.0, *(sign * s for s in sorted(config.shifts_m) for sign in (1, -1))]
    sources = recorded(chunk)
    for k, shift in enumerate(shifts):
        progress(k, len(shifts), f"guards at {shift:+g} m")
        novel = render_novel(chunk, scene, novel_view_poses(chunk, (shift,), frames), config.lidar_max_points)
        yield novel, guards_of(chunk, novel, sources, detector)
    progress(len(shifts), len(shifts), "guards")


def judged(guards: Sequence[Guards], limits: RangeConfig) -> ReliableRange:
    """The curve of medians, and how far it holds. Raises ``ValueError`` without views on the path."""
    by: dict[float, list[Guards]] = {}
    for one in guards:
        by.setdefault(one.shift_m, []).append(one)
    if 0.0 not in by:
        raise ValueError("expected guards at shift 0, which the others are compared with; got none")
    path = _median(by[0.0])
    points = tuple(_point(s, by[s], path, limits) for s in sorted(by))
    left, right = (_reach(points, path, limits, side) for side in (1, -1))
    return ReliableRange(points, tuple(guards), left, right, limits)


def _median(views: Sequence[Guards]) -> dict[str, float]:
    names = ("estimate_db", "agreement_db", "shown", "thin", "floating")
    actors = sum(v.actors for v in views)
    detected = sum(v.detected for v in views) / actors if actors else math.nan
    return {name: statistics.median(getattr(v, name) for v in views) for name in names} | {"detected": detected}


def _point(shift: float, views: Sequence[Guards], path: dict[str, float], limits: RangeConfig) -> CurvePoint:
    here = _median(views)
    return CurvePoint(shift, len(views), **here, holds=all(x <= 0 for x in _excess(here, path, limits)))


def _excess(here: dict[str, float], path: dict[str, float], limits: RangeConfig) -> tuple[float, ...]:
    """By how much each limit is passed; negative where it holds."""
    return (
        path["estimate_db"] - here["estimate_db"] - limits.max_drop_db,
        path["shown"] - here["shown"] - limits.max_hidden,
        here["thin"] - path["thin"] - limits.max_thin,
        here["floating"] - path["floating"] - limits.max_floating,
        _lost(path["detected"], here["detected"]) - limits.max_undetected,
    )


def _lost(before: float, now: float) -> float:
    """Of the share that is detected on the path; 0 where either is not known, or nothing was detected there."""
    return 1 - now / before if math.isfinite(now) and before > 0 else 0.0


def _reach(points: Sequence[CurvePoint], path: dict[str, float], limits: RangeConfig, side: int) -> float:
    """Linear between the last shift that holds and the first that does not."""
    own = sorted((p for p in points if side * p.shift_m >= 0), key=lambda p: abs(p.shift_m))
    for before, after in itertools.pairwise(own):
        if not after.holds:
            pairs = zip(*(_excess(vars(p), path, limits) for p in (before, after)), strict=True)
            part = min(a / (a - b) for a, b in pairs if b > 0)
            return abs(before.shift_m) + part * (abs(after.shift_m) - abs(before.shift_m))
    return abs(own[-1].shift_m)
