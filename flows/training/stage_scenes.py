"""The scenes that a training stage is trained on: which they are, and how they are made and loaded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from flows.training.fixed_images import get_fixed_views, make_stand_in_views
from flows.training.scene_lists import list_scene_recipes
from flows.training.scene_starts import ByGnet, SceneStart, get_start, make_starts
from flows.training.stage_recipe import Stage
from flows.training.train_job import TrainJob
from flows.training.training_scenes import (
    PreparedScene,
    SceneRecipe,
    build_training_scene,
    check_for_training,
    prepare_scene,
)
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.logs.registry import open_log
from genre_tasks.losses.targets import novel_targets
from genre_tasks.optimiser.residual_splitting import split_by_residual
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.novel_views import FixedViews


@dataclass(frozen=True)
class StageScene:
    """A training scene of a stage.

    Attributes:
        recipe: which chunk, at which size.
        start: where its optimisation begins.
    """

    recipe: SceneRecipe
    start: SceneStart


def list_stage_scenes(stage: Stage, real: str | None) -> list[StageScene]:
    """Lists the training scenes of a stage.

    Args:
        stage: the stage.
        real: URI of a log whose chunk 0 is trained on, if any.

    Returns:
        The scenes in order, round after round.

    Raises:
        ConfigError: a chunk is not for training.
    """
    recipes = list_scene_recipes(stage.scenes, real)
    for recipe in recipes:
        check_for_training(recipe)
    # Each round moves the starts on by one, so that a scene is not always met at the same age.
    return [
        StageScene(recipe, stage.starts[(k + turn) % len(stage.starts)])
        for turn in range(stage.scenes.rounds)
        for k, recipe in enumerate(recipes)
    ]


def list_scene_uses(stages: Sequence[Stage], real: str | None) -> dict[SceneRecipe, list[tuple[Stage, SceneStart]]]:
    """Groups the training scenes of several stages by scene, so that each is made at once.

    Args:
        stages: the stages.
        real: URI of a log whose chunk 0 is trained on, if any.

    Returns:
        Scene → (stage, where it begins there), in the order of first use.
    """
    uses: dict[SceneRecipe, list[tuple[Stage, SceneStart]]] = {}
    for stage in stages:
        for scene in list_stage_scenes(stage, real):
            of_scene = uses.setdefault(scene.recipe, [])
            # Rounds repeat a scene at the same start, which needs to be made only once.
            if (stage, scene.start) not in of_scene:
                of_scene.append((stage, scene.start))
    return uses


def rendered_start(stage: Stage, start: SceneStart) -> SceneStart:
    """Finds which state of a scene the fixer is given renders of.

    Args:
        stage: the stage that uses the fixed images.
        start: where the scene's optimisation begins in it.

    Returns:
        The start itself, unless the stage names another.
    """
    if stage.fixed_images is None or stage.fixed_images.rendered is None:
        return start
    return stage.fixed_images.rendered


def make_scene_artifacts(job: TrainJob, recipe: SceneRecipe, uses: Sequence[tuple[Stage, SceneStart]]) -> int:
    """Makes what the store lacks of a training scene, except for what needs weights that are yet to be trained.

    That is: chunk, initial scene, true views, the recipe's reconstructions, FNet's images.

    Args:
        job: the training.
        recipe: the scene.
        uses: the stages that use it, and where it begins there.

    Returns:
        How many artifacts were made.
    """
    store = job.store
    log = open_log(recipe.uri)

    # Counted in the store, because parts of a scene are made on several paths.
    def count_artifacts() -> int:
        return sum(1 for _ in store.artifacts(log.dataset, log.name, recipe.chunk))

    before = count_artifacts()
    scene = prepare_scene(store, recipe)
    # What begins at a GNet's scene has to wait until that GNet is trained.
    ready = [
        (stage, start)
        for stage, start in uses
        if not isinstance(start, ByGnet) and not isinstance(rendered_start(stage, start), ByGnet)
    ]
    starts = [s for stage, start in ready for s in (start, rendered_start(stage, start))]
    make_starts(store, scene, starts, job.stage_weights)
    for stage, start in ready:
        if stage.fixed_images is not None and stage.fixed_images.maker == "fnet":
            _load_fixed_images(job, stage, scene, start)
    return count_artifacts() - before


def load_training_scenes(
    job: TrainJob, stage: Stage, scenes: Sequence[StageScene], progress: Progress = silent
) -> list[TrainingScene]:
    """Loads training scenes from the store; what it lacks is made.

    Args:
        job: the training.
        stage: the stage that uses the scenes.
        scenes: the scenes.
        progress: called with each scene's number, their count and its log.

    Returns:
        The scenes with their targets, on the CPU.
    """
    # A chunk's images are decoded once, however often it is used.
    decoded: dict[SceneRecipe, tuple[PreparedScene, TrainingScene]] = {}
    loaded = []
    for k, scene in enumerate(scenes):
        progress(k, len(scenes), scene.recipe.uri)
        if scene.recipe not in decoded:
            prepared = prepare_scene(job.store, scene.recipe)
            decoded[scene.recipe] = prepared, build_training_scene(prepared)
        prepared, base = decoded[scene.recipe]
        started = get_start(job.store, prepared, scene.start, job.stage_weights)
        fixed_views = _load_fixed_images(job, stage, prepared, scene.start)
        fixed = () if fixed_views is None else novel_targets(fixed_views)
        # Split before the episode begins, as the stage of the pipeline does before its first iteration.
        graph = split_by_residual(started.scene, [*base.source, *fixed], stage.split_fraction)
        name = f"{base.name} {scene.start}"
        # A real log has no true novel views: there the fixed images stand in for them.
        loaded.append(replace(base, name=name, scene=graph, fixed=fixed, truth=base.truth or fixed))
    return loaded


def _load_fixed_images(job: TrainJob, stage: Stage, scene: PreparedScene, start: SceneStart) -> FixedViews | None:
    """The images at novel views that the stage shows its optimiser, if it shows any."""
    if stage.fixed_images is None:
        return None
    rendered = rendered_start(stage, start)
    started = get_start(job.store, scene, rendered, job.stage_weights)
    if stage.fixed_images.maker == "stand_in":
        return make_stand_in_views(scene, started)
    return get_fixed_views(job.store, scene, rendered, started, job.stage_weights, job.fnet)
