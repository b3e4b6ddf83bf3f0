"""Training of FNet as flows: its pairs, one task a scene, and the network. Both go on where they were stopped."""

from __future__ import annotations

from typing import Any

from prefect import flow, task
from prefect.artifacts import create_table_artifact
from prefect.cache_policies import NO_CACHE
from prefect.states import Completed

from flows.pipeline.progress import get_reporter
from flows.training.curve_table import FIXER_CURVE, load_rows
from flows.training.fixer_job import CURVE_FILE, FixerJob
from flows.training.fixer_pairs import get_pairs, list_pair_scenes
from flows.training.fixer_training import kind_fractions, train_fixer
from flows.training.requirements import check_fixer_training
from flows.training.training_scenes import SceneRecipe


# As in `optimiser_flow`, the store and the checkpoints are the cache, and Prefect's own is off.
@flow(name="train-pairs", persist_result=False, validate_parameters=False)
def train_pairs(folder: str = "training", real: str | None = None, streets: int = 28) -> dict[str, Any]:
    """Makes FNet's training pairs.

    Args:
        folder: where everything of the training is kept.
        real: URI of a log whose chunk 0 is trained on too, if any.
        streets: how many synthetic streets.

    Returns:
        ``pairs`` and ``scenes``: how many there are, and ``shares``: the fraction of each kind of pairs.

    Raises:
        ConfigError: there is nothing to make pairs of, a chunk is not for training, or the real log is not 16:9.
    """
    job = FixerJob(folder, real, streets)
    check_fixer_training(job, is_training=False)
    job.store.clean_temporaries()
    scenes = list_pair_scenes(streets, real)
    reporter = get_reporter()
    reporter.part_started("pairs")
    pairs: list[tuple[str, float]] = []
    for k, scene in enumerate(scenes):
        reporter.progress(k, len(scenes), scene.uri)
        # One scene after the other: two would compete for the same cores and double the memory.
        pairs += pairs_task(scene.uri, job, scene, return_state=True).result()
    reporter.part_ended(f"{len(pairs)} pairs of {len(scenes)} scenes")
    return {"scenes": len(scenes), "pairs": len(pairs), "shares": kind_fractions(pairs)}


@flow(name="train-fixer", persist_result=False, validate_parameters=False)
def train_fnet(
    folder: str = "training",
    real: str | None = None,
    streets: int = 28,
    inputs: str = "render+reference+lidar",
    preset: str = "small",
    start: str | None = None,
    steps: int | None = None,
    validate: bool = False,
) -> dict[str, Any]:
    """Trains FNet on its pairs, which are made where they are missing.

    Args:
        folder: where everything of the training is kept.
        real: URI of a log whose chunk 0 is trained on too, if any.
        streets: how many synthetic streets.
        inputs: what the fixer is given, of render, reference and lidar, joined by "+".
        preset: ``small``; ``further``, from its weights; ``last``, from those; ``paper``, from SD-Turbo.
        start: weights to start from, in place of the preset's.
        steps: weight updates, in place of the preset's.
        validate: score on validation streets at each checkpoint.

    Returns:
        ``weights``: path of the weights.

    Raises:
        ConfigError: an input or the preset is unknown, ``paper`` lacks its start, or the real log is not 16:9.
        InputError: the folder holds another training, or the weights to start from do not fit.
    """
    job = FixerJob(folder, real, streets, inputs, preset, start, steps, validate)
    check_fixer_training(job)
    return {"weights": fixer_task(job.run_folder.name, job, return_state=True).result()}


@task(name="training pairs", task_run_name="{uri}", persist_result=False, cache_policy=NO_CACHE)
def pairs_task(uri: str, job: FixerJob, scene: SceneRecipe) -> list[tuple[str, float]]:
    """Makes what the store lacks of a scene's pairs.

    Args:
        uri: the scene's log, for the task's name.
        job: the training.
        scene: the scene.

    Returns:
        Kind and lateral shift in metres of each pair.
    """
    pairs = get_pairs(job.store, scene)
    return list(zip(pairs.kinds, pairs.shift_m.tolist(), strict=True))


@task(name="training fixer", task_run_name="{name}", persist_result=False, cache_policy=NO_CACHE)
def fixer_task(name: str, job: FixerJob) -> Any:
    """Trains a fixer to the end of its preset.

    Args:
        name: the training's folder, for the task's name.
        job: the training.

    Returns:
        Path of the weights; in a ``Cached`` state where they were trained before.
    """
    reporter = get_reporter()
    reporter.part_started(name)
    weights, trained = train_fixer(job, reporter.progress)
    reporter.part_ended("trained" if trained else "trained before")
    if not trained:
        return Completed(name="Cached", message="trained before", data=str(weights))
    rows = load_rows(job.run_folder / CURVE_FILE, FIXER_CURVE)
    # The loss of a single crop is noise, so the table shows a mean.
    last = rows[-100:]
    row = {
        "inputs": job.inputs,
        "weight updates": len(rows),
        "minutes": round(sum(r["seconds"] for r in rows) / 60, 2),
        "loss, last updates": round(sum(r["loss"] for r in last) / len(last), 4),
    }
    create_table_artifact(table=[row], key="training-fnet", description=f"Training of {name}")
    return str(weights)
