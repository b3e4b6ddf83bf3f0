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

from flows.pipeline.progress import current_reporter
from flows.training.scene_starts import Begin
from flows.training.curve_plot import CURVE
from flows.training.recipes import Stage, ordered
from flows.training.training_scenes import SceneRecipe
from flows.training.optimiser_stages import Trained, TrainJob, make_scene, train_stage, works
from genre_tasks.learned.weights import write_atomically
from flows.training.curve_table import LEARNING, read_rows


@flow(name="train-scenes", persist_result=False, validate_parameters=False)
def train_scenes(
    folder: str = "training", recipe: str = "shipped", real: str | None = None, fnet: str = "builtin"
) -> dict[str, int]:
    """Makes the training scenes of a recipe that need no trained GNet: how many there are, and were made now.

    Args:
        folder: where everything of the training is kept. recipe: shipped or paper.
        real: a log whose chunk 0 is trained on too. fnet: the fixer's weights.
    """
    job = TrainJob(folder, recipe, real, fnet=fnet)
    job.store.clean_temporaries()
    uses = works(job.table(), real)
    reporter, made = current_reporter(), 0
    reporter.began("scenes")
    for k, (scene, by) in enumerate(uses.items()):
        reporter.progress(k, len(uses), scene.uri)
        made += scene_task(scene.uri, job, scene, by, return_state=True).result()
    reporter.ended(f"{len(uses)} scenes, {made} parts made")
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
    """Trains ``gnet`` or ``enet``: all the recipe's stages of it, and before them those that they need.

    Args:
        novel: λ_novel of GNet; 0: g3r, in stages of its own. None: the recipe's.
        device: auto, cpu or cuda. save_every, validate_every: weight updates between checkpoints and validations.
        stage: this stage alone; those that it needs have to be trained.

    Returns the path of the network's weights, and the stages with what was trained now.
    """
    job = TrainJob(folder, recipe, real, novel, fnet, device, save_every, validate_every)
    wanted = "g3r" if network == "gnet" and novel == 0 else network
    stages = ordered(job.table(), wanted)
    last = stages[-1].name
    if stage is not None:
        stages = [job.stage(stage)]
    done = [stage_task(s.name, job, s, return_state=True).result() for s in stages]
    weights = Path(done[-1].weights)
    if done[-1].stage == last:
        weights = _published(weights, Path(folder) / f"{wanted}.safetensors")
    return {"weights": str(weights), "stages": [(d.stage, d.cached) for d in done]}


@task(name="training scene", task_run_name="{uri}", persist_result=False, cache_policy=NO_CACHE)
def scene_task(uri: str, job: TrainJob, recipe: SceneRecipe, uses: list[tuple[Stage, Begin]]) -> Any:
    """Makes what the store lacks of a training scene; ends in a ``Cached`` state where it lacks nothing."""
    made = make_scene(job, recipe, uses)
    return made if made else Completed(name="Cached", message="in the store already", data=0)


@task(name="training stage", task_run_name="{name}", persist_result=False, cache_policy=NO_CACHE)
def stage_task(name: str, job: TrainJob, stage: Stage) -> Any:
    """Trains a stage to its end; ends in a ``Cached`` state where it was trained before."""
    reporter = current_reporter()
    reporter.began(name)
    trained = train_stage(job, stage, reporter.progress)
    reporter.ended("trained before" if trained.cached else "trained")
    if trained.cached:
        return Completed(name="Cached", message="trained before", data=trained)
    _show(trained)
    return trained


def _published(weights: Path, path: Path) -> Path:
    """A copy of a network's last weights, with their JSON, where they are easily found."""
    for suffix in (".json", ".safetensors"):
        write_atomically(path.with_suffix(suffix), weights.with_suffix(suffix).read_bytes())
    return path


def _show(trained: Trained) -> None:
    """A table in Prefect's UI; the folder has the whole curve."""
    rows = read_rows(Path(trained.weights).with_name(CURVE), LEARNING)
    last = [r["judged_loss"] for r in rows[-50:]]
    row = {
        "stage": trained.stage,
        "weight updates": len(rows),
        "minutes": round(sum(r["seconds"] for r in rows) / 60, 2),
        "unseen loss, last updates": round(fmean(last), 4) if last else None,
    }
    key = "training-" + "".join(c if c.isalnum() else "-" for c in trained.stage.lower())
    create_table_artifact(table=[row], key=key, description=f"Training of {trained.stage}")
