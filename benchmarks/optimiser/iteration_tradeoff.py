"""What an iteration of GNet costs and brings: its length, its views, the perceptual term; on validation streets."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.common.bench import Row
from benchmarks.common.task import OptimisationTask, load_task
from genre_tasks.config import GnetConfig, RefineConfig
from genre_tasks.stages.optimise import method_for

SEEDS = (900, 901, 902)
"""Of validation: the preset is chosen by these rows."""

SHAPES = ((24, 30), (24, 6), (48, 3), (72, 2), (144, 1), (72, 3), (36, 6), (96, 3), (48, 6))
"""Iterations × source views an iteration; 30 is all of them. Four of the shapes render 144 views."""

REFINEMENTS = ((24, 48, 0.3), (36, 36, 0.3), (72, 48, 0.3), (72, 72, 0.0), (72, 72, 0.3), (72, 72, 0.7))
"""Iterations of three views, iterations of the refinement that follows, and the fraction split in between."""

PERCEPTUAL = {"perceptual 0.1": (0.1, 1), "perceptual 0.1 every fourth": (0.1, 4)}
"""Weight of the term on a 128-pixel crop, and in which iterations it is taken."""


def variant_configs(gnet: GnetConfig) -> dict[str, GnetConfig]:
    """Lists the sections that are compared: the preset's, other shapes, refinement parts, and the perceptual term.

    Args:
        gnet: the preset's section.

    Returns:
        Sections by the name that they have in the table; the preset's comes first.
    """
    # Shapes are compared without a refinement, which would hide what the first part alone does.
    plain = gnet.model_copy(update={"refine": None})
    out = {"preset": gnet}
    out |= {f"{t}x{v}": plain.model_copy(update={"iterations": t, "views_per_iteration": v}) for t, v in SHAPES}
    for first, last, split in REFINEMENTS:
        shape = {"iterations": first + last, "views_per_iteration": 3, "snapshots": 0}
        refine = RefineConfig(fraction_of_iterations=last / (first + last), split_fraction=split)
        out[f"{first}x3, {last}x3 with {split:.0%} more"] = gnet.model_copy(update=shape | {"refine": refine})
    for name, (weight, every) in PERCEPTUAL.items():
        loss = gnet.loss.model_copy(update={"perceptual": weight, "perceptual_every": every})
        out[name] = gnet.model_copy(update={"loss": loss})
    return out


def measure_trade(log: str, store: str, configs: Mapping[str, GnetConfig], over_preset: Sequence[str] = ()) -> Row:
    """Measures every section on chunk 0 of one log.

    Args:
        log: URI.
        store: folder of the artifacts.
        configs: sections by name.
        over_preset: settings over the preset ``small``.

    Returns:
        For each section its seconds, view renders, and PSNR in dB on held-out views and at 3 m.
    """
    task = load_task(log, 0, store, *over_preset)
    # The first call of a process loads libraries; the first section would pay for all of them.
    measure_config(task, next(iter(configs.values())))
    return {"log": log, "chunk": 0, "trade": {name: measure_config(task, config) for name, config in configs.items()}}


def measure_config(task: OptimisationTask, config: GnetConfig) -> dict[str, Any]:
    """Runs GNet once on a task.

    Args:
        task: the scene and its views.
        config: GNet's section.

    Returns:
        Seconds from the scene in memory, loading included; view renders; PSNR in dB.
    """
    # Snapshots are for looking at; writing them down is not part of the optimisation's time.
    began = time.perf_counter()
    method = method_for("gnet", config.model_copy(update={"snapshots": 0}))
    scene = method.run(task.scene, task.source).scene
    seconds = time.perf_counter() - began
    renders = config.iterations * min(config.views_per_iteration, len(task.source))
    # A split looks at every source view once to find the largest residuals.
    if config.refinement is not None and config.refinement.split_fraction:
        renders += len(task.source)
    return {"seconds": seconds, "renders": renders, "psnr": task.psnr(scene), "psnr_3m": task.psnr_novel(scene)}
