"""Training as flows: the scenes that trainings start from, and a network's stages in the order of its recipe.

Both go on where they were stopped: a scene in the store is not made again, a stage resumes at its checkpoint.
"""

from __future__ import annotations

from pathlib import Path
from statistics import fmean
from typing import Any

from prefect import flow, task
from prefect.artifacts import create_table_artifact
from prefect.cache_policies import NO_CACHE
from prefect.states import Completed

from flows.pipeline.progress import get_reporter
from flows.training.curve_plot import CURVE_FILE
from flows.training.curve_table import LEARNING_CURVE, load_rows
from flows.training.optimiser_stages import TrainedStage, train_stage
from flows.training.recipes import select_stages
from flows.training.requirements import check_optimiser_training
from flows.training.scene_starts import SceneStart
from flows.training.stage_recipe import Stage
from flows.training.stage_scenes import list_scene_uses, make_scene_artifacts
from flows.training.train_job import TrainJob
from flows.training.training_scenes import SceneRecipe
from genre_tasks.atomic_path import write_atomically


# The store and the checkpoints are the cache of these flows. Prefect's own is off, since it would not notice that an
# artifact was deleted or damaged.
@flow(name="train-scenes", persist_result=False, validate_parameters=False)
def train_scenes(
    folder: str = "training", recipe: str = "shipped", real: str | None = None, fnet: str = "builtin"
) -> dict[str, int]:
    """Makes the training scenes of a recipe that need no trained GNet.

    Args:
        folder: where everything of the training is kept.
        recipe: ``shipped``, ``paper`` or ``effects``.
        real: URI of a log whose chunk 0 is trained on too, if any.
        fnet: the fixer's weights: a path, or ``builtin``.

    Returns:
        ``scenes``: how many scenes there are, and ``made``: how many artifacts were made now.

    Raises:
        ConfigError: the recipe is unknown, or a chunk is not for training.
    """
    job = TrainJob(folder, recipe, real, fnet=fnet)
    check_optimiser_training(job)
    job.store.clean_temporaries()
    uses = list_scene_uses(job.stages(), real)
    reporter = get_reporter()
    made = 0
    reporter.part_started("scenes")
    for k, (scene, scene_uses) in enumerate(uses.items()):
        reporter.progress(k, len(uses), scene.uri)
        # With its state, because a cached task ends in a state of its own and not in a plain result.
        made += scene_task(scene.uri, job, scene, scene_uses, return_state=True).result()
    reporter.part_ended(f"{len(uses)} scenes, {made} parts made")
    return {"scenes": len(uses), "made": made}


@flow(name="train-network", flow_run_name="{network}", persist_result=False, validate_parameters=False)
def train_network(
    network: str,
    folder: str = "training",
    recipe: str = "shipped",
    real: str | None = None,
    novel: float | None = None,
    fnet: str = "builtin",
    device: str = "auto",
    save_every: int = 50,
    validate_every: int = 0,
    stage: str | None = None,
) -> dict[str, Any]:
    """Trains a network: all the recipe's stages of it, and before them those that they need.

    Args:
        network: ``gnet`` or ``enet``.
        folder: where everything of the training is kept.
        recipe: ``shipped``, ``paper`` or ``effects``.
        real: URI of a log whose chunk 0 is trained on too, if any.
        novel: λ_novel of GNet; 0 for G3R, in stages of its own; ``None`` for the recipe's.
        fnet: the fixer's weights: a path, or ``builtin``.
        device: ``auto``, ``cpu`` or ``cuda``.
        save_every: weight updates between checkpoints.
        validate_every: weight updates between validations; 0 for none.
        stage: this stage alone; those that it needs have to be trained.

    Returns:
        ``weights``: path of the network's weights, and ``stages``: each stage's name and whether it was trained
        before.

    Raises:
        ConfigError: the recipe or the stage is unknown.
        InputError: a stage that is needed is not trained, or a folder holds another training.
    """
    job = TrainJob(folder, recipe, real, novel, fnet, device, save_every, validate_every)
    wanted = job.weights_name(network)
    check_optimiser_training(job, wanted, stage)
    stages = select_stages(job.stages(), wanted)
    last = stages[-1].name
    if stage is not None:
        stages = [job.get_stage(stage)]
    # One after the other, because each stage may start from the weights of the one before.
    trained = [stage_task(s.name, job, s, return_state=True).result() for s in stages]
    weights = Path(trained[-1].weights)
    # One stage alone may be in the middle of the recipe: its weights are not the network's yet.
    if trained[-1].stage == last:
        weights = _publish_weights(weights, Path(folder) / f"{wanted}.safetensors")
    return {"weights": str(weights), "stages": [(t.stage, t.cached) for t in trained]}


@task(name="training scene", task_run_name="{uri}", persist_result=False, cache_policy=NO_CACHE)
def scene_task(uri: str, job: TrainJob, recipe: SceneRecipe, uses: list[tuple[Stage, SceneStart]]) -> Any:
    """Makes what the store lacks of a training scene.

    Args:
        uri: the scene's log, for the task's name.
        job: the training.
        recipe: the scene.
        uses: the stages that use it, and where it begins there.

    Returns:
        How many artifacts were made; a ``Cached`` state with 0 where the store lacks nothing.
    """
    made = make_scene_artifacts(job, recipe, uses)
    return made if made else Completed(name="Cached", message="in the store already", data=0)


@task(name="training stage", task_run_name="{name}", persist_result=False, cache_policy=NO_CACHE)
def stage_task(name: str, job: TrainJob, stage: Stage) -> Any:
    """Trains a stage to its end.

    Args:
        name: the stage's name, for the task's.
        job: the training.
        stage: the stage.

    Returns:
        The trained stage; in a ``Cached`` state where it was trained before.
    """
    reporter = get_reporter()
    reporter.part_started(name)
    trained = train_stage(job, stage, reporter.progress)
    reporter.part_ended("trained before" if trained.cached else "trained")
    if trained.cached:
        return Completed(name="Cached", message="trained before", data=trained)
    _create_summary(trained)
    return trained


def _publish_weights(weights: Path, path: Path) -> Path:
    """Copies a network's last weights, with their JSON, to where they are easily found."""
    # The configuration first: at no moment are there weights that it does not describe.
    for suffix in (".json", ".safetensors"):
        write_atomically(path.with_suffix(suffix), weights.with_suffix(suffix).read_bytes())
    return path


def _create_summary(trained: TrainedStage) -> None:
    """A table in Prefect's UI; the folder has the complete curve."""
    rows = load_rows(Path(trained.weights).with_name(CURVE_FILE), LEARNING_CURVE)
    losses = [row["judged_loss"] for row in rows[-50:]]
    row = {
        "stage": trained.stage,
        "weight updates": len(rows),
        "minutes": round(sum(r["seconds"] for r in rows) / 60, 2),
        "unseen loss, last updates": round(fmean(losses), 4) if losses else None,
    }
    # Prefect takes lower-case letters, digits and dashes for a key.
    key = "training-" + "".join(c if c.isalnum() else "-" for c in trained.stage.lower())
    create_table_artifact(table=[row], key=key, description=f"Training of {trained.stage}")
