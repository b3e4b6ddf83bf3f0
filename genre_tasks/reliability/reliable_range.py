"""The reliable range: how far to each side of the path the guards hold."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from genre_tasks.config import RangeConfig
from genre_tasks.detection.detector import Detector
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.types import DEFAULT_PLAN, EffectsPlan
from genre_tasks.errors import InputError
from genre_tasks.fixer.source_images import load_source_images
from genre_tasks.progress import Progress, silent
from genre_tasks.reliability.guards import Guards, compute_guards
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.lidar_map import build_lidar_scene
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import NovelViews
from genre_tasks.stages.novel_views import render_with_map

_MEDIAN_OF = ("estimate_db", "agreement_db", "shown", "thin", "floating")


@dataclass(frozen=True)
class CurvePoint:
    """The guards at one shift, as medians over its views.

    Attributes:
        shift_m: distance to the left of the path, metres.
        views: number of views.
        estimate_db: the PSNR that views are likely to have, dB.
        agreement_db: PSNR against recorded images, dB.
        shown: fraction of pixels whose depth agrees with some recorded image.
        thin: fraction of pixels that are covered by less than half.
        floating: fraction of pixels far before the LiDAR's depth.
        holds: whether all guards are within the limits.
        detected: fraction of all views' actors that a detector finds; NaN without a detector, or without actors.
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
    """How far to each side of the path a scene can be trusted.

    Attributes:
        points: the curve, from the right to the left, with shift 0 among its points.
        guards: of all views.
        left_m: how far all limits hold to the left, metres; between two shifts where the first limit is crossed.
        right_m: the same to the right.
        limits: what was asked for.
    """

    points: tuple[CurvePoint, ...]
    guards: tuple[Guards, ...]
    left_m: float
    right_m: float
    limits: RangeConfig

    def __str__(self) -> str:
        return f"usable to {self._describe(self.left_m)} left, {self._describe(self.right_m)} right"

    def _describe(self, range_m: float) -> str:
        return f"{range_m:.1f} m{' or more' if range_m >= max(self.limits.shifts_m) else ''}"


def estimate_reliable_range(
    config: RangeConfig,
    chunk: Chunk,
    scene: SceneGraph,
    plan: EffectsPlan = DEFAULT_PLAN,
    progress: Progress = silent,
    detector: Detector | None = None,
) -> ReliableRange:
    """Renders a scene on the path and beside it, and finds how far the guards hold.

    Limits are relative to the path itself. What no image shows there (sky above, what the rig hides) is not the
    shift's fault.

    Args:
        config: shifts, frames and limits.
        chunk: the chunk that the scene is of.
        scene: the scene to judge.
        plan: the effects that the chunk was reconstructed with.
        progress: called for every shift.
        detector: how many road users it finds is a guard, too.

    Returns:
        The range with the curve and the guards that it comes from.

    Raises:
        InputError: an image of the chunk cannot be decoded.
    """
    measured = measure_guards(config, apply_plan(chunk, plan), scene, progress, detector)
    guards = [guard for _, shift_guards in measured for guard in shift_guards]
    return find_reliable_range(guards, config)


def measure_guards(
    config: RangeConfig, chunk: Chunk, scene: SceneGraph, progress: Progress, detector: Detector | None = None
) -> Iterator[tuple[NovelViews, list[Guards]]]:
    """Renders a scene at every shift and measures its guards.

    Args:
        config: shifts and frames.
        chunk: the chunk, with its plan's effects applied.
        scene: the scene to judge.
        progress: called for every shift.
        detector: counts the actors that are still found; ``None``: they are not counted.

    Yields:
        The renders of one frame at one shift and their guards, shift 0 first.

    Raises:
        InputError: the chunk has no image, or one that cannot be decoded.
    """
    # Cameras may be slower than frames, or images be lost.
    seen = sorted({view.frame for view in chunk.views})
    if not seen:
        raise InputError("the chunk has no image", remedy="Choose another --chunk.", log=chunk.log, chunk=chunk.index)
    # From the middle of an interval on, so that few frames stand for the whole chunk.
    frames = seen[config.every // 2 :: config.every] or seen[:1]
    # The path first: everything is compared with it.
    shifts = [0.0]
    for shift in sorted(config.shifts_m):
        shifts += [shift, -shift]
    # Decoded and built once for all shifts.
    sources = load_source_images(chunk)
    lidar_scene = build_lidar_scene(chunk, config.lidar_max_points)
    for k, shift in enumerate(shifts):
        progress(k, len(shifts), f"guards at {shift:+g} m")
        for frame in frames:
            views = place_novel_views(chunk, (shift,), [frame])
            novel = render_with_map(chunk, scene, lidar_scene, views)
            yield novel, compute_guards(chunk, novel, sources, detector)
    progress(len(shifts), len(shifts), "guards")


def find_reliable_range(guards: Sequence[Guards], limits: RangeConfig) -> ReliableRange:
    """Finds how far guards stay within limits.

    Args:
        guards: of views on the path and beside it.
        limits: how much worse than on the path each guard may be.

    Raises:
        ValueError: there is no view on the path.
    """
    by_shift: dict[float, list[Guards]] = {}
    for guard in guards:
        by_shift.setdefault(guard.shift_m, []).append(guard)
    # Every limit is relative to the path.
    if 0.0 not in by_shift:
        raise ValueError("expected guards at shift 0, which the others are compared with; got none")
    path = _summarise(by_shift[0.0])
    points = tuple(_curve_point(shift, by_shift[shift], path, limits) for shift in sorted(by_shift))
    return ReliableRange(
        points=points,
        guards=tuple(guards),
        left_m=_find_reach(points, path, limits, side=1),
        right_m=_find_reach(points, path, limits, side=-1),
        limits=limits,
    )


def _summarise(views: Sequence[Guards]) -> dict[str, float]:
    """Medians of the guards, and the fraction of actors that is detected."""
    summary = {name: statistics.median(getattr(view, name) for view in views) for name in _MEDIAN_OF}
    # Over all views together: many show no actor or one, so that a median of fractions would be 0 or 1.
    actors = sum(view.actors for view in views)
    summary["detected"] = sum(view.detected for view in views) / actors if actors else math.nan
    return summary


def _curve_point(shift: float, views: Sequence[Guards], path: dict[str, float], limits: RangeConfig) -> CurvePoint:
    summary = _summarise(views)
    holds = all(excess <= 0 for excess in _limit_excess(summary, path, limits))
    return CurvePoint(shift, len(views), **summary, holds=holds)


def _limit_excess(here: dict[str, float], path: dict[str, float], limits: RangeConfig) -> tuple[float, ...]:
    """By how much each limit is passed; negative where it holds."""
    return (
        # Path minus here where more is better, here minus path where less is.
        path["estimate_db"] - here["estimate_db"] - limits.max_drop_db,
        path["shown"] - here["shown"] - limits.max_hidden,
        here["thin"] - path["thin"] - limits.max_thin,
        here["floating"] - path["floating"] - limits.max_floating,
        _lost_fraction(path["detected"], here["detected"]) - limits.max_undetected,
    )


def _lost_fraction(on_path: float, here: float) -> float:
    """Fraction of the detections on the path that is lost; 0 where either is unknown or nothing was detected there."""
    return 1 - here / on_path if math.isfinite(here) and on_path > 0 else 0.0


def _find_reach(points: Sequence[CurvePoint], path: dict[str, float], limits: RangeConfig, side: int) -> float:
    """Metres up to where the first limit is crossed, linear between the shifts on both sides of it."""
    # Shift 0 belongs to both sides.
    outward = sorted((p for p in points if side * p.shift_m >= 0), key=lambda p: abs(p.shift_m))
    for inner, outer in itertools.pairwise(outward):
        # A shift that holds beyond one that does not is of no use: a vehicle could not get there.
        if not outer.holds:
            inner_excess = _limit_excess(vars(inner), path, limits)
            outer_excess = _limit_excess(vars(outer), path, limits)
            # The excess is taken as linear in between; the first limit to be crossed ends the range.
            crossings = [a / (a - b) for a, b in zip(inner_excess, outer_excess, strict=True) if b > 0]
            return abs(inner.shift_m) + min(crossings) * (abs(outer.shift_m) - abs(inner.shift_m))
    return abs(outward[-1].shift_m)
