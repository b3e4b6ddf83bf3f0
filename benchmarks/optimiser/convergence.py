"""How far GNet goes: a longer T, against tuned Adam run until it gains no more."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

from benchmarks.common.bench import Row
from benchmarks.common.task import OptimisationTask, load_task
from benchmarks.optimiser import race
from benchmarks.optimiser.cells import curve_rows, variants
from benchmarks.optimiser.race import Point
from flows.configuration import load_configuration
from genre_tasks.config import GnetConfig

PRESET = "long"
LONG_RENDERS = 960
"""Of tuned Adam's cosines only those of so many view renders converge."""
CLOSE_DB = 0.2
"""To the converged PSNR."""
SETTLED_FACTOR = 1.5
SETTLED_DB = 0.05
"""A constant schedule has settled where it gained less than this while its time grew by this factor."""
FIRST_LOOK_S = 0.5


def measure_converged(log: str, chunk: int, store: str, order: int, cap: float, settings: Sequence[str] = ()) -> Row:
    """Measures the preset ``long`` and tuned Adam's long variants from the same scene.

    Args:
        log: URI.
        chunk: index in the log.
        store: folder of the artifacts.
        order: seed of the order of views.
        cap: ratio that counts where GNet never gets there.
        settings: over the preset.

    Returns:
        The row of the cell.
    """
    task = load_task(log, chunk, store, *settings)
    configs = long_variants(variants("tuned_adam"))
    row = converged_row(task, load_configuration(PRESET, settings=settings).gnet, configs, order)
    return {"log": log, "chunk": chunk, "order": order, "cap": cap} | row


def long_variants(configs: Mapping[str, GnetConfig]) -> dict[str, GnetConfig]:
    """Chooses the variants that converge: long cosines, and constant schedules, which can go on.

    Args:
        configs: sections by name.

    Returns:
        Cosines of at least ``LONG_RENDERS`` view renders, and all constant schedules.
    """
    return {
        name: c
        for name, c in configs.items()
        if c.adam.schedule == "constant" or c.iterations * c.views_per_iteration >= LONG_RENDERS
    }


def converged_row(task: OptimisationTask, gnet: GnetConfig, configs: Mapping[str, GnetConfig], order: int) -> Row:
    """Runs GNet and all variants to convergence.

    Args:
        task: the scene and its views.
        gnet: GNet's section.
        configs: tuned Adam's sections by name.
        order: seed of the order of views.

    Returns:
        The highest PSNR of all variants, and the seconds of GNet and of the first variant to within ``CLOSE_DB`` of it.
    """
    # Otherwise GNet, which runs first, would pay for code that tuned Adam finds loaded.
    race.warm_up(task, gnet, order)
    # A constant schedule gets as many renders as the longest cosine, so that neither is cut short.
    most = max(c.iterations * c.views_per_iteration for c in configs.values())
    gnet_curve = run_to_convergence(task, gnet, order, gnet.iterations * gnet.views_per_iteration)
    curves = {name: run_to_convergence(task, config, order, most) for name, config in configs.items()}
    plateau = max(best_psnr(curve) for curve in curves.values())
    # The plateau itself is reached by one variant only, and late; within CLOSE_DB of it the comparison is robust.
    goal = plateau - CLOSE_DB
    times = [t for curve in curves.values() if (t := race.time_to_reach(curve, goal)) is not None]
    return {
        "iterations": gnet.iterations,
        "plateau": plateau,
        "goal": goal,
        "gnet": _summary(gnet_curve) | {"reached_s": race.time_to_reach(gnet_curve, goal)},
        "adam": {
            name: _summary(curve) | {"reached_s": race.time_to_reach(curve, goal)} for name, curve in curves.items()
        },
        "adam_s": min(times),
    }


def run_to_convergence(task: OptimisationTask, config: GnetConfig, seed: int, most_renders: int) -> list[Point]:
    """Runs an optimiser until it gains no more: a learned one or a cosine to its length, a constant one until settled.

    Args:
        task: the scene and its views.
        config: GNet's section.
        seed: of the order of views.
        most_renders: view renders after which a constant schedule is stopped at the latest.

    Returns:
        The curve, from the start on, with growing intervals.
    """
    # A cosine ends with a learning rate of zero; only a constant schedule can go on.
    endless = config.method == "adam" and config.adam.schedule == "constant"
    length = None if endless else config.iterations
    due = FIRST_LOOK_S
    out = [race.score_start(task)]
    for moment in itertools.islice(race.gnet_steps(task, config, seed), length):
        last = moment.iteration == length or (endless and moment.renders >= most_renders)
        if last or moment.seconds >= due:
            out.append(race.score_scene(task, moment.seconds, moment.renders, moment.scene))
            # Growing intervals: a score takes as long as many steps.
            due = moment.seconds * race.SCORE_INTERVAL_GROWTH
        if last or (endless and has_settled(out)):
            break
    return out


def has_settled(points: Sequence[Point]) -> bool:
    """Whether the best PSNR hardly grew since the time was ``SETTLED_FACTOR`` times shorter.

    Args:
        points: of a curve, the start first.

    Returns:
        False for a curve that is too short to tell.
    """
    # The start is at second 0 and would always be among the earlier points.
    before = [p for p in points[1:] if p.seconds <= points[-1].seconds / SETTLED_FACTOR]
    return bool(before) and best_psnr(points) - best_psnr(before) < SETTLED_DB


def best_psnr(points: Sequence[Point]) -> float:
    """Finds the highest PSNR of a curve.

    >>> best_psnr([Point(0.0, 0, 20.0, 1), Point(1.0, 4, 22.0, 1), Point(2.0, 8, 21.0, 1)])
    22.0
    """
    return max(p.psnr for p in points)


def _summary(points: Sequence[Point]) -> Row:
    end = points[-1]
    return {"seconds": end.seconds, "renders": end.renders, "best_psnr": best_psnr(points), "curve": curve_rows(points)}
