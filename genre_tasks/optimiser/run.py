"""From a stage's configuration to its optimisation: method, targets, plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from genre_tasks.config import FinishConfig, GnetConfig, OptimiserConfig
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.optimiser import targets
from genre_tasks.optimiser.adam import ENET_RATES, GNET_RATES, TunedAdam
from genre_tasks.optimiser.learned import LearnedOptimiser
from genre_tasks.optimiser.loss import Distance
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.per_scene import PerSceneTraining
from genre_tasks.optimiser.per_scene_run import reconstruct
from genre_tasks.optimiser.per_scene_start import world_static
from genre_tasks.optimiser.rules import StepRule
from genre_tasks.optimiser.targets import Target
from genre_tasks.optimiser.unroll import Plan, unroll
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.results import Reconstruction
from genre_tasks.scene.views import FixedViews
from genre_tasks.weights import network_of, resolve_weights

StageName = Literal["gnet", "enet"]
PER_SCENE = ("standard_3dgs", "street_gs")


def optimise(
    stage: StageName,
    config: OptimiserConfig,
    chunk: Chunk,
    scene: SceneGraph,
    fixed: FixedViews | None,
    progress: Progress = silent,
) -> Reconstruction:
    """Source views of ``chunk`` and, where given, ``fixed`` novel views; see the stages for what is raised."""
    if isinstance(config, GnetConfig) and config.method in PER_SCENE:
        return per_scene(stage, config, chunk, scene, progress)
    source = targets.of_source(chunk, depth=config.loss.depth > 0)
    return unrolled(stage, config, scene, source, () if fixed is None else targets.of_fixed(fixed), progress)


def unrolled(
    stage: StageName,
    config: OptimiserConfig,
    scene: SceneGraph,
    source: Sequence[Target],
    novel: Sequence[Target] = (),
    progress: Progress = silent,
) -> Reconstruction:
    """The learned optimiser or tuned Adam from ``scene``, and what follows where the configuration has it."""
    objective, whole = Objective(config.loss, distance(config)), config.total_iterations

    def overall(done: int, total: int, note: str = "") -> None:
        progress(done, whole, note)

    def further(done: int, total: int, note: str = "") -> None:
        progress(config.iterations + done, whole, note)

    first = unroll(step_rule(stage, config), scene, source, novel, objective, plan_of(stage, config), overall)
    if not isinstance(config, GnetConfig) or config.finishing is None:
        return first
    rule, plan = finishing_rule(config.finishing), finishing_plan(config, config.finishing)
    return _joined(first, unroll(rule, first.scene, source, novel, objective, plan, further))


def finishing_plan(config: GnetConfig, finish: FinishConfig) -> Plan:
    """As the section's, with another order of views."""
    return replace(
        plan_of("gnet", config),
        iterations=finish.iterations,
        snapshots=config.snapshots - _of_first(config),
        seed=config.seed + 1,
        split=finish.split,
    )


def finishing_rule(finish: FinishConfig) -> StepRule:
    """The learned optimiser with the weights that are configured for what follows. Raises as :func:`step_rule`."""
    return LearnedOptimiser.load(resolve_weights("gnet", finish.weights))


def _of_first(config: OptimiserConfig) -> int:
    """Snapshots that the first T iterations keep."""
    return round(config.snapshots * config.iterations / config.total_iterations)


def _joined(first: Reconstruction, then: Reconstruction) -> Reconstruction:
    """One after the other."""
    before = len(first.losses)
    return replace(
        then,
        losses=first.losses + then.losses,
        snapshots=first.snapshots | {before + k: scene for k, scene in then.snapshots.items()},
        seconds_per_iteration=first.seconds_per_iteration + then.seconds_per_iteration,
    )


def plan_of(stage: StageName, config: OptimiserConfig) -> Plan:
    """How far and how often to look, as the configuration says."""
    return Plan(
        config.iterations,
        config.views_per_iteration,
        config.novel_views_per_iteration,
        _of_first(config),
        config.seed,
        stage,
        config.hold_ground,
        deform=stage == "gnet",  # the fixer's images of people are no measure of their shape
        split=config.split,
    )


def planned(config: OptimiserConfig, plan: EffectsPlan) -> OptimiserConfig:
    """The configuration without the loss terms that the plan leaves out."""
    if plan.on("lidar_depth"):
        return config
    update: dict[str, object] = {"loss": config.loss.model_copy(update={"depth": 0.0})}
    if isinstance(config, GnetConfig):
        update["per_scene"] = config.per_scene.model_copy(update={"depth": 0.0})
    return config.model_copy(update=update)


def per_scene(
    stage: StageName, config: GnetConfig, chunk: Chunk, scene: SceneGraph, progress: Progress = silent
) -> Reconstruction:
    """Per-scene 3DGS on the source views: on the scene graph as Street Gaussians, or with everything static."""
    start = scene if config.method == "street_gs" else world_static(scene)
    source = targets.of_source(chunk, depth=config.per_scene.depth > 0)
    training = PerSceneTraining(config.per_scene, start, source, config.seed, stage)
    plan = Plan(config.per_scene.iterations, 1, snapshots=config.snapshots)
    return reconstruct(training, plan.snapshot_iterations(), progress)


def step_rule(stage: StageName, config: OptimiserConfig) -> StepRule:
    """The learned optimiser with the configured weights, or tuned Adam.

    Raises ``InputError`` for weights missing or unfit.
    """
    if config.method == "adam":
        rates = GNET_RATES if stage == "gnet" else ENET_RATES
        return TunedAdam(config.adam.rates or rates, config.adam.schedule)
    return LearnedOptimiser.load(resolve_weights(network_of(stage, config.method), config.weights))


def distance(config: OptimiserConfig) -> Distance | None:
    """The perceptual distance, where the loss has a term for it."""
    if config.loss.perceptual == 0:
        return None
    from genre_tasks.metrics.perceptual import perceptual_distance

    return perceptual_distance()
