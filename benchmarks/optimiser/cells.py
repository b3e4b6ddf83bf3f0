"""What is measured on one log: GNet beside a baseline, and GNet and ENet far past their lengths."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch

from benchmarks.common.bench import Row
from benchmarks.common.pipeline_inputs import steps_of
from benchmarks.common.task import HELDOUT_VIEWS, Task, task_of
from benchmarks.optimiser import race
from benchmarks.optimiser.race import Point
from flows.configuration import load_configuration
from flows.paper_tables.baselines import load_baselines
from flows.training.training_scenes import spread
from genre_tasks.config import GnetConfig, OptimiserConfig
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.objective import Objective
from genre_tasks.stages.optimise import StageName, distance, plan_of, step_rule

ADAM = ("tuned_adam", "tuned_adam_split")
METHODS = (*ADAM, "standard_3dgs", "street_gs")
PAST = 10


def measure_race(log: str, chunk: int, store: str, order: int, method: str, cap: float) -> Row:
    """GNet, then every variant of the method with the same scene, views and order seed, up to ``cap`` × GNet's time."""
    task, gnet = task_of(log, chunk, store), load_configuration("small").gnet
    return {"log": log, "chunk": chunk, "order": order} | race_row(task, gnet, variants(method), order, method, cap)


def race_row(task: Task, gnet: GnetConfig, configs: dict[str, GnetConfig], order: int, method: str, cap: float) -> Row:
    """The row but for where it is from."""
    curve = race.learned(task, gnet, order)
    goal = curve[-1]
    cap_s = cap * goal.seconds
    run = race.adam if method in ADAM else race.per_scene
    out = {name: variant_row(run(task, config, order, goal, cap_s), goal, cap_s) for name, config in configs.items()}
    sizes = {"gaussians": len(task.scene), "source_views": len(task.source), "heldout_views": len(task.heldout)}
    goals = {"seconds": goal.seconds, "renders": goal.renders, "psnr": goal.psnr, "curve": as_rows(curve)}
    return sizes | {"method": method, "cap": cap, "gnet": goals, "variants": out}


def variant_row(curve: Sequence[Point], goal: Point, cap_s: float) -> Row:
    """When a variant reached the goal (null: never), why it ended, and the best it came to."""
    found = race.reached(curve, goal.psnr)
    end = curve[-1]
    return {
        "reached_s": found,
        "ended": "reached" if found is not None else "cap" if end.seconds >= cap_s else "length",
        "ended_s": end.seconds,
        "renders": end.renders,
        "gaussians": end.gaussians,
        "best_psnr": max(p.psnr for p in curve),
        "psnr_at_equal_renders": race.at_renders(curve, goal.renders),
        "curve": as_rows(curve),
    }


def as_rows(curve: Sequence[Point]) -> list[list[float]]:
    """Seconds, renders, PSNR, Gaussians, and where there is truth PSNR 3 m beside the path."""
    return [
        [round(p.seconds, 3), p.renders, round(p.psnr, 3), p.gaussians]
        + ([] if p.beside is None else [round(p.beside, 3)])
        for p in curve
    ]


def variants(method: str) -> dict[str, GnetConfig]:
    """Of ``configs/baselines.yaml``, on the preset ``small``."""
    return dict(load_baselines("small")[method].variants)


def measure_stability(log: str, chunk: int, store: str, network: StageName) -> Row:
    """GNet or ENet to ten times its length, still told its length; ENet from GNet's scene with its fixed images."""
    where = {"log": log, "chunk": chunk, "network": network}
    if network == "gnet":
        return where | stability_row(task_of(log, chunk, store), "gnet", load_configuration("small").gnet)
    steps = steps_of(log, chunk, store, 0, enet=False)
    task = Task(steps.gnet, steps.source, spread(steps.heldout, HELDOUT_VIEWS))
    return where | stability_row(task, "enet", steps.config.enet, steps.fixed)


def stability_row(task: Task, network: StageName, config: OptimiserConfig, fixed: Sequence[Target] = ()) -> Row:
    """Loss on all source and fixed views, and held-out PSNR, at T, 2T, 5T and 10T, each beside T's.

    An end of GNet's own goes on past T. ENet is walked with its perceptual term, which the loss that counts leaves out.
    """
    objective, total = Objective(config.loss.model_copy(update={"perceptual": 0.0})), config.iterations
    if isinstance(config, GnetConfig):
        moments = race.configured(task, config, config.seed)
    else:
        own = Objective(config.loss, distance(config))
        moments = race.walk(lambda: (step_rule(network, config), own), task, plan_of(network, config), fixed)
    losses, psnrs = {}, {}
    for moment in itertools.islice(moments, PAST * total):
        if moment.iteration in (total, 2 * total, 5 * total, PAST * total):
            times, targets = str(moment.iteration // total), (*task.source, *fixed)
            losses[times] = objective(moment.frame, moment.state.offsets, targets, 0, torch.Generator()).loss
            psnrs[times] = task.psnr(moment.scene)
    return {"iterations": total, "loss": losses, "heldout_psnr": psnrs, "ratio": losses[str(PAST)] / losses["1"]}
