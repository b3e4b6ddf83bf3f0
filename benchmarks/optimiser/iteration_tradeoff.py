"""What an iteration of GNet costs and brings: its length, its views, the perceptual term; on validation streets."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from benchmarks.common.bench import Row
from benchmarks.common.task import Task, task_of
from genre_tasks.config import GnetConfig, RefineConfig
from genre_tasks.stages.optimise import unrolled

SEEDS = (900, 901, 902)
"""Of validation: the preset is chosen by these rows."""

SHAPES = ((24, 30), (24, 6), (48, 3), (72, 2), (144, 1), (72, 3), (36, 6), (96, 3), (48, 6))
"""Iterations × source views an iteration; 30 is all of them. Four of the shapes render 144 views."""

FINISHES = ((24, 48, 0.3), (36, 36, 0.3), (72, 48, 0.3), (72, 72, 0.0), (72, 72, 0.3), (72, 72, 0.7))
"""Iterations of three views, those of an end of its own that follows, and what is split between."""

PERCEPTUAL = {"perceptual 0.1": (0.1, 1), "perceptual 0.1 every fourth": (0.1, 4)}
"""Weight of the term on a 128-pixel crop, and in which iterations it is taken."""


def settings(gnet: GnetConfig) -> dict[str, GnetConfig]:
    """By name: the preset's section, in every shape and with some ends of its own, and with the perceptual term."""
    plain = gnet.model_copy(update={"refine": None})
    out = {"preset": gnet}
    out |= {f"{t}x{v}": plain.model_copy(update={"iterations": t, "views_per_iteration": v}) for t, v in SHAPES}
    for first, last, split in FINISHES:
        shape = {"iterations": first + last, "views_per_iteration": 3, "snapshots": 0}
        finish = RefineConfig(fraction_of_iterations=last / (first + last), split_fraction=split)
        out[f"{first}x3, {last}x3 with {split:.0%} more"] = gnet.model_copy(update=shape | {"refine": finish})
    for name, (weight, every) in PERCEPTUAL.items():
        loss = gnet.loss.model_copy(update={"perceptual": weight, "perceptual_every": every})
        out[name] = gnet.model_copy(update={"loss": loss})
    return out


def measure_trade(log: str, store: str, configs: Mapping[str, GnetConfig]) -> Row:
    """Seconds from the scene in memory, loading included, view renders, and PSNR in dB held out and at 3 m."""
    task = task_of(log, 0, store)
    trade(task, next(iter(configs.values())))  # the first call of a process loads libraries
    return {"log": log, "chunk": 0, "trade": {name: trade(task, config) for name, config in configs.items()}}


def trade(task: Task, config: GnetConfig) -> dict[str, Any]:
    """One run."""
    began = time.perf_counter()
    scene = unrolled("gnet", config.model_copy(update={"snapshots": 0}), task.scene, task.source).scene
    seconds = time.perf_counter() - began
    renders = config.iterations * min(config.views_per_iteration, len(task.source))
    if config.refinement is not None and config.refinement.split_fraction:
        renders += len(task.source)
    return {"seconds": seconds, "renders": renders, "psnr": task.psnr(scene), "psnr_3m": task.psnr_beside(scene)}
