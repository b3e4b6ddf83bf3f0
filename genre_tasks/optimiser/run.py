"""From a stage's configuration to the unrolled optimisation: rule, targets, plan."""

from __future__ import annotations

from typing import Literal

from genre_tasks.config import OptimiserConfig
from genre_tasks.optimiser import targets
from genre_tasks.optimiser.adam import ENET_RATES, GNET_RATES, TunedAdam
from genre_tasks.optimiser.learned import LearnedOptimiser
from genre_tasks.optimiser.loss import Distance
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.rules import StepRule
from genre_tasks.optimiser.unroll import Plan, unroll
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.results import Reconstruction
from genre_tasks.scene.views import FixedViews
from genre_tasks.weights import resolve_weights

StageName = Literal["gnet", "enet"]


def optimise(
    stage: StageName,
    config: OptimiserConfig,
    chunk: Chunk,
    scene: SceneGraph,
    fixed: FixedViews | None,
    progress: Progress = silent,
) -> Reconstruction:
    """Source views of ``chunk`` and, where given, ``fixed`` novel views; see the stages for what is raised."""
    rule = step_rule(stage, config)
    source = targets.of_source(chunk, depth=config.loss.depth > 0)
    novel = () if fixed is None else targets.of_fixed(fixed)
    plan = Plan(
        config.iterations,
        config.views_per_iteration,
        config.novel_views_per_iteration,
        config.snapshots,
        config.seed,
        stage,
    )
    return unroll(rule, scene, source, novel, Objective(config.loss, distance(config)), plan, progress)


def step_rule(stage: StageName, config: OptimiserConfig) -> StepRule:
    """The learned optimiser with the configured weights, or tuned Adam."""
    if config.method == "adam":
        return TunedAdam(GNET_RATES if stage == "gnet" else ENET_RATES)
    return LearnedOptimiser.load(resolve_weights(stage, config.weights))


def distance(config: OptimiserConfig) -> Distance | None:
    """The perceptual distance, where the loss has a term for it."""
    if config.loss.perceptual == 0:
        return None
    from genre_tasks.metrics.perceptual import perceptual_distance

    return perceptual_distance()
