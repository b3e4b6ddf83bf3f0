"""Checks all that a training needs before any work; scenes take hours before a network reads its weights."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flows.configuration import load_configuration
from flows.preflight.requirements import check_inputs
from flows.preflight.store_checks import check_store
from flows.training.fixer_job import FixerJob
from flows.training.fixer_pairs import list_pair_scenes
from flows.training.fixer_training import require_same_inputs
from flows.training.recipes import select_stages
from flows.training.stage_scenes import list_scene_uses
from flows.training.train_job import TrainJob
from flows.training.training_scenes import SceneRecipe, check_for_training
from genre_tasks.config import FnetConfig, IngestConfig
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.fixer.network import INPUTS
from genre_tasks.fixer.training_checkpoint import CHECKPOINT_FILE, count_steps
from genre_tasks.fixer.training_settings import STARTS_FROM
from genre_tasks.fixer.weight_files import check_described_weights, check_fixer_files, check_sd_turbo
from genre_tasks.logs.log_selection import choose_working_size
from genre_tasks.logs.types import Camera

_TRAINING_PRESET = "small"


def check_optimiser_training(job: TrainJob, network: str | None = None, stage: str | None = None) -> None:
    """Checks what a training of GNet or ENet needs, or the making of its scenes.

    Args:
        job: the training.
        network: gnet, enet or g3r; ``None`` for scenes alone.
        stage: this stage alone; ``None`` for all of the network.

    Raises:
        ConfigError: the recipe, the stage or the device is unknown, the device cannot render the scenes, the stage is
            another network's, or a chunk is not for training.
        InputError: the real log or the fixer's weights are missing or unfit, or the folder cannot be written to.
    """
    stages = list(job.stages()) if network is None else select_stages(job.stages(), network)
    if stage is not None:
        found = job.get_stage(stage)
        if network is not None and found.network_name != network:
            remedy = f"Train it with `genre train {found.network_name}`."
            raise ConfigError(f"{stage} is no stage of {network}", remedy=remedy)
        stages = [found]
    job.choose_device()
    for scene in list_scene_uses(stages, job.real):
        check_for_training(scene)
    _check_real_log(job.real)
    check_fixer_files(FnetConfig(weights=job.fnet))
    check_store(str(job.store.root))


def check_fixer_training(job: FixerJob, is_training: bool = True) -> None:
    """Checks what a training of FNet needs, or the making of its pairs.

    Args:
        job: the training.
        is_training: whether the network is trained, too.

    Raises:
        ConfigError: there is nothing to make pairs of, a chunk is not for training, or the real log's pairs and those
            of streets have different sizes.
        InputError: the real log or the weights to start from are missing or unfit, the training to go on from has not
            come to its end, or the folder cannot be written to.
    """
    scenes = list_pair_scenes(job.streets, job.real)
    cameras = _check_real_log(job.real)
    if job.real is not None and job.streets:
        # The real log comes first in the list.
        _require_same_shape(scenes[0], cameras)
    check_store(str(job.store.root))
    if not is_training:
        return
    if job.sd_turbo is not None:
        check_sd_turbo(job.sd_turbo, Path())
    elif job.initial_weights is not None:
        path, described = _check_initial_weights(job, job.initial_weights)
        require_same_inputs(described.get("inputs", INPUTS), job, path)
        # Weights that the user names are taken as they are.
        if job.start is None:
            _require_finished(job.initial_weights.with_name(CHECKPOINT_FILE))


def _require_same_shape(scene: SceneRecipe, cameras: Sequence[Camera]) -> None:
    """Raises where a real log's pairs cannot be joined with those of streets: that shows only once all are made."""
    # Ingest keeps the images' shape, so that a wide log's pairs are wider and lower than a street's.
    config = IngestConfig(width_px=scene.width_px, height_px=scene.height_px)
    width_px, height_px = choose_working_size(config, cameras)
    if (width_px, height_px) != (scene.width_px, scene.height_px):
        raise ConfigError(
            f"pairs of {scene.uri} have {width_px}×{height_px} pixels, those of streets "
            f"{scene.width_px}×{scene.height_px}",
            remedy="Give `--streets 0`, or a log of 16:9.",
        )


def _check_initial_weights(job: FixerJob, weights: Path) -> tuple[Path, dict[str, Any]]:
    """Checks the weights that a training starts from; returns their file, and what describes their network."""
    try:
        return check_described_weights(weights, "small")
    except InputError as error:
        if job.start is not None:
            raise
        # The error is about weights that somebody named; these come from the training before.
        before = STARTS_FROM[job.preset]
        command = "genre train fnet" if before == "small" else f"genre train fnet --preset {before}"
        raise InputError(
            "the weights to go on from are missing or damaged",
            remedy=f"Run `{command}` first, or name weights with --start.",
            file=weights,
        ) from error


def _require_finished(checkpoint: Path) -> None:
    """Raises where the training to go on from was stopped: it writes weights at every checkpoint."""
    # Weights that were copied here without one are taken as they are, too.
    if not checkpoint.is_file():
        return
    done, steps = count_steps(checkpoint)
    if done < steps:
        remedy = "Run its command again first, or name weights with --start."
        raise InputError(f"the training to go on from has made {done} of {steps} steps", remedy=remedy, file=checkpoint)


def _check_real_log(real: str | None) -> Sequence[Camera]:
    """Checks what is read of a real log; returns its cameras."""
    return () if real is None else check_inputs(real, [0], load_configuration(_TRAINING_PRESET)).cameras
