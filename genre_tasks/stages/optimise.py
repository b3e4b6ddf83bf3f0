"""From a stage's configuration to its optimisation: method, targets, plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from genre_tasks.config import GnetConfig, OptimiserConfig, RefineConfig
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.learned.weights import load
from genre_tasks.losses import targets
from genre_tasks.losses.rendering_loss import Distance
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.optimiser.tuned_adam import ENET_RATES, GNET_RATES, TunedAdam
from genre_tasks.optimiser.unroll import Plan, unroll
from genre_tasks.per_scene.run import reconstruct
from genre_tasks.per_scene.setup import world_static
from genre_tasks.per_scene.training import PerSceneTraining
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import FixedViews
from genre_tasks.scene.reconstruction import Reconstruction
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
    """The learned optimiser or tuned Adam from ``scene``, and its end where the configuration has one of its own."""
    finish = config.refinement if isinstance(config, GnetConfig) else None
    rule, objective = step_rule(stage, config), Objective(config.loss, distance(config))
    last = None if finish is None else refine_rule(finish)  # so early that weights unfit are said before any work
    plan = plan_of(stage, config)

    def after(before: int) -> Progress:
        return lambda done, _, note="": progress(before + done, config.iterations, note)

    first = unroll(rule, scene, source, novel, objective, plan, after(0))
    if last is None or finish is None:
        return first
    end = refine_plan(config, finish)
    return _joined(first, unroll(last, first.scene, source, novel, objective, end, after(plan.iterations)))


def refine_plan(config: OptimiserConfig, finish: RefineConfig) -> Plan:
    """As the first iterations', with another order of views."""
    first = plan_of("gnet", config)
    return replace(
        first,
        iterations=config.refine_iterations,
        snapshots=config.snapshots - first.snapshots,
        seed=config.seed + 1,
        split=finish.split_fraction,
    )


def refine_rule(finish: RefineConfig) -> StepRule:
    """The learned optimiser with the weights that are configured for the end. Raises as :func:`step_rule`."""
    return load(resolve_weights("gnet", finish.weights, "gnet.refine.weights"))


def _joined(first: Reconstruction, last: Reconstruction) -> Reconstruction:
    """One after the other."""
    before = len(first.losses)
    return replace(
        last,
        losses=first.losses + last.losses,
        snapshots=first.snapshots | {before + k: scene for k, scene in last.snapshots.items()},
        seconds_per_iteration=first.seconds_per_iteration + last.seconds_per_iteration,
    )


def plan_of(stage: StageName, config: OptimiserConfig) -> Plan:
    """How far and how often to look, as the configuration says; of an end of its own see :func:`refine_plan`."""
    iterations = config.iterations - config.refine_iterations
    return Plan(
        iterations,
        config.views_per_iteration,
        config.novel_views_per_iteration,
        round(config.snapshots * iterations / config.iterations),
        config.seed,
        stage,
        config.constrain_ground,
        deform=stage == "gnet",  # the fixer's images of people are no measure of their shape
        split=config.split_fraction,
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
        own = GNET_RATES if stage == "gnet" else ENET_RATES
        return TunedAdam(
            config.adam.learning_rates.as_tuple() if config.adam.learning_rates else own, config.adam.schedule
        )
    learned = load(resolve_weights(network_of(stage, config.method), config.weights))
    finish = config.refinement if isinstance(config, GnetConfig) else None
    rates = config.learning_rates if finish is None or finish.lr_before_refine is None else finish.lr_before_refine
    return learned if rates is None else learned.at_rates(rates.as_tuple())


def distance(config: OptimiserConfig) -> Distance | None:
    """The perceptual distance, where the loss has a term for it."""
    if config.loss.perceptual == 0:
        return None
    from genre_tasks.metrics.perceptual import perceptual_distance

    return perceptual_distance()
