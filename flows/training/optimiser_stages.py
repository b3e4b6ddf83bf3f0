"""A training stage as plain functions: its network, its checkpoints, its validation; what the flows and tests call."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from flows.machine.folder_lock import hold_training_folder
from flows.pipeline.definition import digest_weights
from flows.training import checkpoint
from flows.training.device import move_scene
from flows.training.fixed_images import fixed_images_key
from flows.training.optimiser_training import CHECKPOINT_FILE, WEIGHTS_FILE, initialise_network, train_optimiser
from flows.training.scene_starts import scene_start_key
from flows.training.stage_recipe import Stage
from flows.training.stage_scenes import StageScene, list_stage_scenes, load_training_scenes, rendered_start
from flows.training.train_job import TrainJob
from flows.training.validation import SCORES_FILE, Validation, list_validation_recipes
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.learned.weight_files import check_optimiser_files
from genre_tasks.learned.weights import save_optimiser
from genre_tasks.losses.rendering_loss import ImageDistance
from genre_tasks.optimiser.unroll import UnrollSettings
from genre_tasks.progress import Progress, silent
from storage.keys import digest_value


@dataclass(frozen=True)
class TrainedStage:
    """The result of training a stage.

    Attributes:
        stage: its name.
        weights: path of its weights.
        cached: it was trained before.
    """

    stage: str
    weights: str
    cached: bool


def train_stage(job: TrainJob, stage: Stage, progress: Progress = silent) -> TrainedStage:
    """Trains a stage to its end in its folder, or finds it trained; a stopped training resumes to the same bytes.

    Args:
        job: the training.
        stage: the stage.
        progress: called with scenes while they are loaded, then with weight updates.

    Returns:
        The stage's weights.

    Raises:
        InputError: a stage that it needs is not trained, its folder holds another training, or another process trains
            in it.
    """
    with hold_training_folder(Path(job.folder) / stage.name):
        return _train_or_find(job, stage, progress)


def _train_or_find(job: TrainJob, stage: Stage, progress: Progress) -> TrainedStage:
    folder = Path(job.folder) / stage.name
    weights = folder / WEIGHTS_FILE
    stage_scenes = list_stage_scenes(stage, job.real)
    # Computed before any scene is loaded, so that a finished stage is found within a second.
    origin = _digest_origin(job, stage, stage_scenes)
    if (folder / CHECKPOINT_FILE).is_file() and _is_finished(folder / CHECKPOINT_FILE, stage, origin):
        # Weights may have been deleted or damaged after the last checkpoint, which still has them.
        if not _are_sound(weights):
            _restore_weights(stage, folder)
        return TrainedStage(stage.name, str(weights), cached=True)
    # Scores without a checkpoint are of a training that was deleted since.
    if not (folder / CHECKPOINT_FILE).is_file():
        (folder / SCORES_FILE).unlink(missing_ok=True)
    initial = None if stage.initial_weights is None else job.stage_weights(stage.initial_weights)
    device = job.choose_device()
    # Made on the CPU and then moved, so that new weights do not depend on the device.
    network = initialise_network(stage.network, 0, initial, stage.new_head).to(device)
    scenes = [move_scene(scene, device) for scene in load_training_scenes(job, stage, stage_scenes, progress)]
    distance = _load_distance(stage, device)
    on_checkpoint = None
    # Validation needs scenes of its own, which take minutes to make.
    if job.validate_every:
        on_checkpoint = _build_validation(job, stage, folder, distance).score_at_checkpoint
    train_optimiser(
        network,
        scenes,
        stage.config,
        folder,
        distance=distance,
        save_every=job.save_every,
        on_checkpoint=on_checkpoint,
        progress=progress,
        origin=origin,
    )
    return TrainedStage(stage.name, str(weights), cached=False)


def _digest_origin(job: TrainJob, stage: Stage, scenes: Sequence[StageScene]) -> dict[str, str]:
    """Digests of what the training depends on and its configuration does not say: initial weights and scenes."""
    # The code is not part of it, so that a stopped training goes on after a change that does not concern it.
    fixed_images = stage.fixed_images
    keys = []
    for scene in scenes:
        keys.append(scene_start_key(scene.recipe, scene.start, job.stage_weights))
        if fixed_images is not None and fixed_images.maker == "fnet":
            rendered = rendered_start(stage, scene.start)
            keys.append(fixed_images_key(scene.recipe, rendered, job.stage_weights, job.fnet))
    maker = None if fixed_images is None else fixed_images.maker
    initial = None if stage.initial_weights is None else digest_weights(job.stage_weights(stage.initial_weights))
    return {"start": initial or "none", "training scenes": digest_value([maker, *keys])}


def _is_finished(path: Path, stage: Stage, origin: dict[str, str]) -> bool:
    """Whether the checkpoint is the end of just this training."""
    described = checkpoint.describe(path)
    config = stage.config.model_dump(mode="json")
    network = stage.network.model_dump(mode="json")
    # One that does not fit counts as unfinished: resuming it is what names the difference.
    fits = (described["config"], described["network"], described["origin"]) == (config, network, origin)
    return fits and described["done"] >= stage.config.steps


def _are_sound(weights: Path) -> bool:
    """Whether a stage's weights are there, complete and described, as far as headers tell."""
    try:
        check_optimiser_files(weights)
    except (InputError, ConfigError):
        return False
    return True


def _restore_weights(stage: Stage, folder: Path) -> None:
    """Writes the weights of a finished training from its checkpoint."""
    network = initialise_network(stage.network, 0)
    checkpoint.load_weights(network, folder / CHECKPOINT_FILE)
    save_optimiser(network, folder / WEIGHTS_FILE)


def _load_distance(stage: Stage, device: torch.device) -> ImageDistance | None:
    """The perceptual distance, where a loss of the stage has a term for it."""
    if stage.config.loss.perceptual == 0 and stage.config.held_out_loss.perceptual == 0:
        return None
    # Imported here: most stages have no such term and need not load its network.
    from genre_tasks.metrics.perceptual import perceptual_distance

    return perceptual_distance().to(device)


def _build_validation(job: TrainJob, stage: Stage, folder: Path, distance: ImageDistance | None) -> Validation:
    config = stage.config
    device = job.choose_device()

    # A function, because validation scenes are only made once a validation is due.
    def load_scenes() -> list[TrainingScene]:
        scenes = [StageScene(recipe, stage.starts[0]) for recipe in list_validation_recipes(stage.scenes)]
        return [move_scene(scene, device) for scene in load_training_scenes(job, stage, scenes)]

    # Networks train at several lengths and numbers of views; they are scored at the most frequent of each.
    plan = UnrollSettings(
        statistics.mode(config.iterations), statistics.mode(config.views), config.novel_views, stage=stage.network_name
    )
    return Validation(
        folder=folder,
        load_scenes=load_scenes,
        loss=config.loss,
        plan=plan,
        adam_learning_rates=stage.network.rates,
        distance=distance,
        every=job.validate_every,
        steps=config.steps,
    )
