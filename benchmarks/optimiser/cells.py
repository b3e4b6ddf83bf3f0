"""What is measured on one log: GNet against a baseline, and GNet and ENet far past their lengths."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch

from benchmarks.common.bench import Row
from benchmarks.common.pipeline_inputs import load_pipeline_inputs
from benchmarks.common.task import HELDOUT_VIEWS, OptimisationTask, load_task
from benchmarks.optimiser import race
from benchmarks.optimiser.race import Point
from flows.configuration import load_configuration
from flows.paper_tables.baselines import load_baselines
from flows.training.training_scenes import evenly_spaced
from genre_tasks.config import GnetConfig, OptimiserConfig
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.objective import Objective
from genre_tasks.stages.optimise import StageName

ADAM = ("tuned_adam", "tuned_adam_split")
METHODS = (*ADAM, "standard_3dgs", "street_gs")
PAST = 10


def measure_race(
    log: str, chunk: int, store: str, order: int, method: str, cap: float, settings: Sequence[str] = ()
) -> Row:
    """Measures GNet, then every variant of a method with the same scene, views and order.

    Args:
        log: URI.
        chunk: index in the log.
        store: folder of the artifacts.
        order: seed of the order of views.
        method: one of ``METHODS``.
        cap: a variant is given up after so many times GNet's seconds.
        settings: over the preset ``small``.

    Returns:
        The row of the cell.
    """
    task = load_task(log, chunk, store, *settings)
    gnet = load_configuration("small", settings=settings).gnet
    return {"log": log, "chunk": chunk, "order": order} | race_row(task, gnet, variants(method), order, method, cap)


def race_row(
    task: OptimisationTask, gnet: GnetConfig, configs: dict[str, GnetConfig], order: int, method: str, cap: float
) -> Row:
    """Races GNet against the variants of a method on a task.

    Args:
        task: the scene and its views.
        gnet: GNet's section.
        configs: the variants by name.
        order: seed of the order of views.
        method: one of ``METHODS``.
        cap: a variant is given up after so many times GNet's seconds.

    Returns:
        The row of the cell, without the log.
    """
    # Otherwise GNet, which runs first, would pay for code that the other methods find loaded.
    race.warm_up(task, gnet, order)
    # GNet runs anew in every cell: the machine's speed drifts, and only neighbours in time compare.
    curve = race.run_learned(task, gnet, order)
    goal = curve[-1]
    cap_s = cap * goal.seconds
    # Per-scene 3DGS has a training loop of its own, with densification.
    run = race.run_adam if method in ADAM else race.run_per_scene
    out = {name: variant_row(run(task, config, order, goal, cap_s), goal, cap_s) for name, config in configs.items()}
    # Sizes are in the row, because seconds mean little without them.
    sizes = {"gaussians": len(task.scene), "source_views": len(task.source), "heldout_views": len(task.heldout)}
    goals = {"seconds": goal.seconds, "renders": goal.renders, "psnr": goal.psnr, "curve": curve_rows(curve)}
    return sizes | {"method": method, "cap": cap, "gnet": goals, "variants": out}


def variant_row(curve: Sequence[Point], goal: Point, cap_s: float) -> Row:
    """Summarises the run of a variant.

    Args:
        curve: of the variant.
        goal: GNet's end.
        cap_s: seconds at which the variant was given up.

    Returns:
        When it reached the goal (null: never), why it ended, and the best that it came to.
    """
    reached_s = race.time_to_reach(curve, goal.psnr)
    end = curve[-1]
    return {
        "reached_s": reached_s,
        "ended": "reached" if reached_s is not None else "cap" if end.seconds >= cap_s else "length",
        "ended_s": end.seconds,
        "renders": end.renders,
        "gaussians": end.gaussians,
        # The best and not the last: a curve that fell again had been good enough in between.
        "best_psnr": max(p.psnr for p in curve),
        "psnr_at_equal_renders": race.psnr_at_renders(curve, goal.renders),
        "curve": curve_rows(curve),
    }


def curve_rows(curve: Sequence[Point]) -> list[list[float]]:
    """Rounds a curve for the JSON.

    Args:
        curve: of a run.

    Returns:
        Seconds, renders, PSNR and Gaussians of each point, and PSNR at 3 m where there is truth.

    >>> curve_rows([Point(1.23456, 8, 25.0, 300)])
    [[1.235, 8, 25.0, 300]]
    """
    # Three digits, a millisecond and a thousandth of a decibel, keep the committed JSON small.
    return [
        [round(p.seconds, 3), p.renders, round(p.psnr, 3), p.gaussians]
        + ([] if p.beside is None else [round(p.beside, 3)])
        for p in curve
    ]


def variants(method: str) -> dict[str, GnetConfig]:
    """Reads a method's variants from ``configs/baselines.yaml``, on the preset ``small``."""
    return dict(load_baselines("small")[method].variants)


def measure_stability(log: str, chunk: int, store: str, network: StageName, settings: Sequence[str] = ()) -> Row:
    """Runs GNet or ENet to ten times its length, while its schedule is that of its length.

    Args:
        log: URI.
        chunk: index in the log.
        store: folder of the artifacts.
        network: gnet, or enet from GNet's scene with its fixed images.
        settings: over the preset ``small``.

    Returns:
        The row of the cell.
    """
    where = {"log": log, "chunk": chunk, "network": network}
    if network == "gnet":
        gnet = load_configuration("small", settings=settings).gnet
        return where | stability_row(load_task(log, chunk, store, *settings), "gnet", gnet)
    # ENet needs GNet's scene and FNet's images, so the pipeline runs up to there first.
    steps = load_pipeline_inputs(log, chunk, store, 0, False, *settings)
    task = OptimisationTask(steps.gnet, steps.source, evenly_spaced(steps.heldout, HELDOUT_VIEWS))
    return where | stability_row(task, "enet", steps.config.enet, steps.fixed)


def stability_row(
    task: OptimisationTask, network: StageName, config: OptimiserConfig, fixed: Sequence[Target] = ()
) -> Row:
    """Measures what happens past a network's length T.

    Args:
        task: the scene and its views.
        network: gnet or enet.
        config: its section.
        fixed: images of FNet.

    Returns:
        Loss on all source and fixed views and held-out PSNR at T, 2T, 5T and 10T, and the loss at 10T over that at T.
    """
    # ENet steps with its perceptual term, but the loss that counts leaves it out: it would be of a random crop.
    objective = Objective(config.loss.model_copy(update={"perceptual": 0.0}))
    total = config.iterations
    if isinstance(config, GnetConfig):
        moments = race.gnet_steps(task, config, config.seed)
    else:
        moments = race.stage_steps(network, task, config, config.seed, fixed)
    losses = {}
    psnrs = {}
    for moment in itertools.islice(moments, PAST * total):
        if moment.iteration in (total, 2 * total, 5 * total, PAST * total):
            times = str(moment.iteration // total)
            targets = (*task.source, *fixed)
            losses[times] = moment.loop.evaluate_views(targets, objective, 0, torch.Generator()).loss
            psnrs[times] = task.psnr(moment.scene)
    return {"iterations": total, "loss": losses, "heldout_psnr": psnrs, "ratio": losses[str(PAST)] / losses["1"]}
