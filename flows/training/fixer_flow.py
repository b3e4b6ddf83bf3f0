"""Training of FNet as flows: its pairs, one task a scene, and the network. Both go on where they were stopped."""

from __future__ import annotations

from typing import Any

from prefect import flow, task
from prefect.artifacts import create_table_artifact
from prefect.cache_policies import NO_CACHE
from prefect.states import Completed

from flows.pipeline.progress import current_reporter
from flows.training.fixer_training import CURVE, FixerJob, shares, train_fixer
from flows.training.fixer_pairs import pair_scenes, pairs_of
from flows.training.training_scenes import SceneRecipe
from flows.training.curve_table import FIXING, read_rows


@flow(name="train-pairs", persist_result=False, validate_parameters=False)
def train_pairs(folder: str = "training", real: str | None = None, streets: int = 28) -> dict[str, Any]:
    """Makes FNet's training pairs: how many there are of how many scenes, and the share of each kind.

    Args:
        folder: where everything of the training is kept. real: a log whose chunk 0 is trained on too.
        streets: how many synthetic streets.
    """
    job = FixerJob(folder, real, streets)
    job.store.clean_temporaries()
    scenes = pair_scenes(streets, real)
    reporter = current_reporter()
    reporter.began("pairs")
    pairs: list[tuple[str, float]] = []
    for k, scene in enumerate(scenes):
        reporter.progress(k, len(scenes), scene.uri)
        pairs += pairs_task(scene.uri, job, scene, return_state=True).result()
    reporter.ended(f"{len(pairs)} pairs of {len(scenes)} scenes")
    return {"scenes": len(scenes), "pairs": len(pairs), "shares": shares(pairs)}


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
    """Trains FNet on the pairs, which are made where they are missing: the path of its weights.

    Args:
        inputs: what it is given, of render, reference and lidar.
        preset: small; further, which starts from its weights; last, from those; paper, from SD-Turbo.
        start: weights to start from. steps: the preset's if not given. validate: score at each checkpoint.
    """
    job = FixerJob(folder, real, streets, inputs, preset, start, steps, validate)
    return {"weights": fixer_task(job.place.name, job, return_state=True).result()}


@task(name="training pairs", task_run_name="{uri}", persist_result=False, cache_policy=NO_CACHE)
def pairs_task(uri: str, job: FixerJob, scene: SceneRecipe) -> list[tuple[str, float]]:
    """Makes what the store lacks of a scene's pairs; the kind and the shift of each."""
    pairs = pairs_of(job.store, scene)
    return list(zip(pairs.kinds, pairs.shift_m.tolist(), strict=True))


@task(name="training fixer", task_run_name="{name}", persist_result=False, cache_policy=NO_CACHE)
def fixer_task(name: str, job: FixerJob) -> Any:
    """Trains to the end; ends in a ``Cached`` state where that was done before."""
    reporter = current_reporter()
    reporter.began(name)
    weights, trained = train_fixer(job, reporter.progress)
    reporter.ended("trained" if trained else "trained before")
    if not trained:
        return Completed(name="Cached", message="trained before", data=str(weights))
    rows = read_rows(job.place / CURVE, FIXING)
    last = rows[-100:]
    row = {
        "inputs": job.inputs,
        "weight updates": len(rows),
        "minutes": round(sum(r["seconds"] for r in rows) / 60, 2),
        "loss, last updates": round(sum(r["loss"] for r in last) / len(last), 4),
    }
    create_table_artifact(table=[row], key="training-fnet", description=f"Training of {name}")
    return str(weights)
