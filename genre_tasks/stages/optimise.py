"""From a stage's configuration to the optimiser that it asks for, and to the stage's result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

from genre_tasks.config import GnetConfig, OptimiserConfig, RefineConfig
from genre_tasks.learned.weights import load_optimiser
from genre_tasks.losses import targets
from genre_tasks.losses.rendering_loss import ImageDistance
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.optimiser.tuned_adam import ENET_LEARNING_RATES, GNET_LEARNING_RATES, TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.per_scene.run import reconstruct_per_scene
from genre_tasks.per_scene.setup import freeze_actors
from genre_tasks.per_scene.training import PerSceneTraining
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import FixedViews
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.weights import resolve_weights, select_network

StageName = Literal["gnet", "enet"]
PER_SCENE_METHODS = ("standard_3dgs", "street_gs")


class SceneOptimiser(Protocol):
    """A method that optimises a scene against images; its configuration is in it."""

    @property
    def needs_depth(self) -> bool:
        """Whether the source views must have LiDAR depth."""
        ...

    def run(
        self, scene: SceneGraph, source: Sequence[Target], novel: Sequence[Target] = (), progress: Progress = silent
    ) -> Reconstruction:
        """Optimises a scene to the method's end.

        Args:
            scene: where the optimisation starts.
            source: source views, at least one.
            novel: fixed novel views.
            progress: called after each iteration.

        Returns:
            Reconstruction: the last scene, and the snapshots on the way.

        Raises:
            NonFiniteError: the optimisation has diverged.
            InputError: no view saw any Gaussian.
        """
        ...


@dataclass(frozen=True)
class UnrolledPart:
    """Iterations of one step rule.

    Attributes:
        rule: how the Gaussians move.
        settings: how many iterations, and what each renders.
    """

    rule: StepRule
    settings: UnrollSettings


@dataclass(frozen=True)
class UnrolledOptimiser:
    """The learned optimiser or tuned Adam, in one part or, with a refinement, in two.

    Attributes:
        objective: the loss.
        parts: run one after the other; each starts from the scene that the one before it left.
    """

    objective: Objective
    parts: tuple[UnrolledPart, ...]

    @property
    def needs_depth(self) -> bool:
        """Whether the loss has a term for LiDAR depth."""
        # LiDAR depth is projected into every source view, which takes time that a loss without the term would waste.
        return self.objective.config.depth > 0

    def run(
        self, scene: SceneGraph, source: Sequence[Target], novel: Sequence[Target] = (), progress: Progress = silent
    ) -> Reconstruction:
        """Runs all parts; see :class:`SceneOptimiser`."""
        total = sum(part.settings.iterations for part in self.parts)
        result = Reconstruction(scene)
        for part in self.parts:
            report = _report_from(progress, before=len(result.losses), all_iterations=total)
            following = unroll(part.rule, result.scene, source, novel, self.objective, part.settings, report)
            result = _concatenate(result, following)
        return result


def _report_from(progress: Progress, before: int, all_iterations: int) -> Progress:
    """Progress of a part, counted from the iterations before it."""

    # ``total`` is that of the part; the caller is shown the iterations of all parts.
    def report(done: int, total: int, note: str = "") -> None:
        progress(before + done, all_iterations, note)

    return report


@dataclass(frozen=True)
class PerSceneOptimiser:
    """Per-scene 3DGS on the source views: on the scene graph as Street Gaussians, or with everything static.

    Attributes:
        stage: names the run in errors.
        config: with the method and the settings of per-scene training.
    """

    stage: StageName
    config: GnetConfig

    @property
    def needs_depth(self) -> bool:
        """Whether the training's loss has a term for LiDAR depth."""
        return self.config.per_scene.depth > 0

    def run(
        self, scene: SceneGraph, source: Sequence[Target], novel: Sequence[Target] = (), progress: Progress = silent
    ) -> Reconstruction:
        """Trains to the end; see :class:`SceneOptimiser`. It does not use ``novel``."""
        config = self.config
        # The published 3DGS has no scene graph: without actors, moving cars are part of the static world.
        start = scene if config.method == "street_gs" else freeze_actors(scene)
        training = PerSceneTraining(config.per_scene, start, source, config.seed, self.stage)
        # Only for its spread of snapshots over the iterations.
        settings = UnrollSettings(config.per_scene.iterations, 1, snapshots=config.snapshots)
        return reconstruct_per_scene(training, settings.snapshot_iterations(), progress)


def method_for(stage: StageName, config: OptimiserConfig) -> UnrolledOptimiser | PerSceneOptimiser:
    """Builds the optimiser that a stage's configuration asks for, and loads its weights.

    Args:
        stage: gnet or enet.
        config: the stage's section.

    Returns:
        SceneOptimiser: ready to run.

    Raises:
        InputError: weights are missing or do not fit, those of the refinement too: before any work is done.
    """
    if isinstance(config, GnetConfig) and config.method in PER_SCENE_METHODS:
        return PerSceneOptimiser(stage, config)
    # All weights are loaded here, before images are decoded: a wrong path fails in seconds.
    parts = [UnrolledPart(load_step_rule(stage, config), make_unroll_settings(stage, config))]
    refine = config.refinement if isinstance(config, GnetConfig) else None
    if refine is not None:
        parts.append(UnrolledPart(load_refine_rule(refine), make_refine_settings(config, refine)))
    return UnrolledOptimiser(Objective(config.loss, load_distance(config)), tuple(parts))


def optimise(
    stage: StageName,
    config: OptimiserConfig,
    chunk: Chunk,
    scene: SceneGraph,
    fixed: FixedViews | None,
    progress: Progress = silent,
) -> Reconstruction:
    """Runs a stage's optimiser on the views of a chunk.

    Args:
        stage: gnet or enet.
        config: the stage's section.
        chunk: its source views supervise.
        scene: where the optimisation starts.
        fixed: fixed novel views, which supervise too.
        progress: called after each iteration.

    Returns:
        Reconstruction: the last scene, and the snapshots on the way.

    Raises:
        InputError: the chunk has no source view, an image is unreadable, or weights are missing or do not fit.
        NonFiniteError: the optimisation has diverged.
    """
    method = method_for(stage, config)
    source = targets.source_targets(chunk, depth=method.needs_depth)
    novel = () if fixed is None else targets.novel_targets(fixed)
    return method.run(scene, source, novel, progress)


def make_unroll_settings(stage: StageName, config: OptimiserConfig) -> UnrollSettings:
    """Takes the settings of the first part from a stage's configuration.

    Args:
        stage: gnet or enet.
        config: the stage's section.

    Returns:
        UnrollSettings: of all iterations but those of a refinement, with their fraction of the snapshots.
    """
    iterations = config.iterations - config.refine_iterations
    return UnrollSettings(
        iterations,
        config.views_per_iteration,
        novel_views=config.novel_views_per_iteration,
        # In proportion to its iterations, so that the snapshots of all parts are spread evenly.
        snapshots=round(config.snapshots * iterations / config.iterations),
        seed=config.seed,
        stage=stage,
        constrain_ground=config.constrain_ground,
        # The fixer's images of people do not show their shape reliably, so ENet keeps GNet's deformation.
        fit_deformation=stage == "gnet",
        split_fraction=config.split_fraction,
    )


def make_refine_settings(config: OptimiserConfig, refine: RefineConfig) -> UnrollSettings:
    """Takes the settings of the refinement from GNet's configuration.

    Args:
        config: GNet's section.
        refine: its refinement.

    Returns:
        UnrollSettings: as those of the first part, with another order of views and its own split.
    """
    first = make_unroll_settings("gnet", config)
    return replace(
        first,
        iterations=config.refine_iterations,
        snapshots=config.snapshots - first.snapshots,
        # The first part's seed would repeat its order of views.
        seed=config.seed + 1,
        split_fraction=refine.split_fraction,
    )


def load_step_rule(stage: StageName, config: OptimiserConfig) -> StepRule:
    """Loads the learned optimiser with the configured weights, or sets up tuned Adam.

    Args:
        stage: gnet or enet.
        config: the stage's section.

    Returns:
        StepRule: of the first part, at the configured learning rates.

    Raises:
        InputError: weights are missing or do not fit.
    """
    if config.method == "adam":
        defaults = GNET_LEARNING_RATES if stage == "gnet" else ENET_LEARNING_RATES
        return TunedAdam(config.adam.learning_rates or defaults, config.adam.schedule)
    # A method may have weights of its own, as G3R has.
    learned = load_optimiser(resolve_weights(select_network(stage, config.method), config.weights))
    learning_rates = config.learning_rates
    refine = config.refinement if isinstance(config, GnetConfig) else None
    # Rates that are best for a run to the very end are too small where a refinement follows.
    if refine is not None and refine.lr_before_refine is not None:
        learning_rates = refine.lr_before_refine
    return learned if learning_rates is None else learned.with_learning_rates(learning_rates)


def load_refine_rule(refine: RefineConfig) -> StepRule:
    """Loads the learned optimiser with the weights of a refinement.

    Args:
        refine: of GNet's section.

    Returns:
        StepRule: at the learning rates that the weights were trained with.

    Raises:
        InputError: weights are missing or do not fit.
    """
    return load_optimiser(resolve_weights("gnet", refine.weights, "gnet.refine.weights"))


def load_distance(config: OptimiserConfig) -> ImageDistance | None:
    """Loads the perceptual distance, where the loss has a term for it.

    Args:
        config: a stage's section.

    Returns:
        The distance; ``None`` where its weight is 0.
    """
    if config.loss.perceptual == 0:
        return None
    # Imported where it is needed: it loads a network, and most presets do without the term.
    from genre_tasks.metrics.perceptual import perceptual_distance

    return perceptual_distance()


def _concatenate(first: Reconstruction, second: Reconstruction) -> Reconstruction:
    """The second run's result, with the losses, times and snapshots of both."""
    # The second run counts its snapshots from 0.
    before = len(first.losses)
    return replace(
        second,
        losses=first.losses + second.losses,
        snapshots=first.snapshots | {before + k: scene for k, scene in second.snapshots.items()},
        seconds_per_iteration=first.seconds_per_iteration + second.seconds_per_iteration,
    )
