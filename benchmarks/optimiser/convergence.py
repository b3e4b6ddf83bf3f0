"""How far it goes: GNet with a longer T beside tuned Adam run until it gains no more."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

from benchmarks.common.bench import Row
from benchmarks.common.task import Task, task_of
from benchmarks.optimiser import race
from benchmarks.optimiser.cells import as_rows, variants
from benchmarks.optimiser.race import Point
from flows.configuration import load_configuration
from genre_tasks.config import GnetConfig

PRESET = "long"
LONG_RENDERS = 960
"""Of tuned Adam's cosines only those of so many view renders converge."""
CLOSE_DB = 0.2
"""To the converged PSNR."""
SETTLED_FACTOR, SETTLED_DB = 1.5, 0.05
"""A constant schedule has settled where it gained less than this while its time grew by this factor."""
FIRST_LOOK_S = 0.5


def measure_converged(log: str, chunk: int, store: str, order: int, cap: float) -> Row:
    """One cell: the preset ``long`` and tuned Adam's long variants from the same scene."""
    task = task_of(log, chunk, store)
    configs = long_variants(variants("tuned_adam"))
    row = converged_row(task, load_configuration(PRESET).gnet, configs, order)
    return {"log": log, "chunk": chunk, "order": order, "cap": cap} | row


def long_variants(configs: Mapping[str, GnetConfig]) -> dict[str, GnetConfig]:
    """Cosines of at least ``LONG_RENDERS`` view renders, and all constant ones, which can go on."""
    return {
        name: c
        for name, c in configs.items()
        if c.adam.schedule == "constant" or c.iterations * c.views_per_iteration >= LONG_RENDERS
    }


def converged_row(task: Task, gnet: GnetConfig, configs: Mapping[str, GnetConfig], order: int) -> Row:
    """The plateau of all variants, and when GNet and when the first of them came within ``CLOSE_DB`` of it."""
    most = max(c.iterations * c.views_per_iteration for c in configs.values())
    own = to_the_end(task, gnet, order, gnet.iterations * gnet.views_per_iteration)
    curves = {name: to_the_end(task, config, order, most) for name, config in configs.items()}
    plateau = max(best(curve) for curve in curves.values())
    goal = plateau - CLOSE_DB
    times = [t for curve in curves.values() if (t := race.reached(curve, goal)) is not None]
    return {
        "iterations": gnet.iterations,
        "plateau": plateau,
        "goal": goal,
        "gnet": _of(own) | {"reached_s": race.reached(own, goal)},
        "adam": {name: _of(curve) | {"reached_s": race.reached(curve, goal)} for name, curve in curves.items()},
        "adam_s": min(times),
    }


def to_the_end(task: Task, config: GnetConfig, seed: int, most_renders: int) -> list[Point]:
    """A learned optimiser or a cosine to its length, a constant schedule until it has settled; looks get rarer."""
    endless = config.method == "adam" and config.adam.schedule == "constant"
    length = None if endless else config.iterations
    due, out = FIRST_LOOK_S, [race.start(task)]
    for moment in itertools.islice(race.configured(task, config, seed), length):
        last = moment.iteration == length or (endless and moment.renders >= most_renders)
        if last or moment.seconds >= due:
            out.append(race.point(task, moment.seconds, moment.renders, moment.scene))
            due = moment.seconds * race.LOOK_FACTOR
        if last or (endless and settled(out)):
            break
    return out


def settled(points: Sequence[Point]) -> bool:
    """Whether the best PSNR hardly grew since the time was ``SETTLED_FACTOR`` times shorter."""
    before = [p for p in points[1:] if p.seconds <= points[-1].seconds / SETTLED_FACTOR]
    return bool(before) and best(points) - best(before) < SETTLED_DB


def best(points: Sequence[Point]) -> float:
    """The highest PSNR of a curve."""
    return max(p.psnr for p in points)


def _of(points: Sequence[Point]) -> Row:
    end = points[-1]
    return {"seconds": end.seconds, "renders": end.renders, "best_psnr": best(points), "curve": as_rows(points)}
