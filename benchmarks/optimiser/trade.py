"""What an iteration of GNet costs and brings: its length, its views, the perceptual term; on validation streets."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from benchmarks.bench import Row
from benchmarks.optimiser.cells import threads
from benchmarks.optimiser.task import Task, task_of
from genre_tasks.config import GnetConfig
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.run import distance, step_rule
from genre_tasks.optimiser.unroll import Plan, unroll

SEEDS = (900, 901, 902)
"""Of validation: the preset is chosen by these rows."""

SHAPES = ((24, 30), (24, 6), (48, 3), (72, 2), (144, 1), (72, 3), (36, 6), (96, 3), (48, 6))
"""Iterations × source views an iteration; 30 is all of them. Four of the shapes render 144 views."""

PERCEPTUAL = {"perceptual 0.1": (0.1, 1), "perceptual 0.1 every fourth": (0.1, 4)}
"""Weight of the term on a 128-pixel crop, and in which iterations it is taken."""


def settings(gnet: GnetConfig) -> dict[str, GnetConfig]:
    """By name: the preset's section in every shape, and in its own with the perceptual term."""
    out = {f"{t}x{v}": gnet.model_copy(update={"iterations": t, "views_per_iteration": v}) for t, v in SHAPES}
    for name, (weight, every) in PERCEPTUAL.items():
        loss = gnet.loss.model_copy(update={"perceptual": weight, "perceptual_every": every})
        out[name] = gnet.model_copy(update={"loss": loss})
    return out


def measure_trade(log: str, store: str, configs: Mapping[str, GnetConfig]) -> Row:
    """Seconds from the scene in memory, loading included, view renders, and PSNR in dB held out and at 3 m."""
    task = task_of(log, 0, store)
    with threads():
        trade(task, next(iter(configs.values())))  # the first call of a process loads libraries
        return {"log": log, "chunk": 0, "trade": {name: trade(task, config) for name, config in configs.items()}}


def trade(task: Task, config: GnetConfig) -> dict[str, Any]:
    """One run."""
    began = time.perf_counter()
    rule, objective = step_rule("gnet", config), Objective(config.loss, distance(config))
    plan = Plan(config.iterations, config.views_per_iteration, seed=config.seed)
    scene = unroll(rule, task.scene, task.source, (), objective, plan).scene
    seconds = time.perf_counter() - began
    renders = config.iterations * min(config.views_per_iteration, len(task.source))
    return {"seconds": seconds, "renders": renders, "psnr": task.psnr(scene), "psnr_3m": task.psnr_beside(scene)}
