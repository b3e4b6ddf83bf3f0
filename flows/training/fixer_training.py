"""Training of FNet as plain functions: its pairs, the network, its scores on validation streets."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flows.machine.folder_lock import hold_training_folder
from flows.training.curve_table import FIXER_CURVE, FIXER_SCORES, load_rows, save_rows
from flows.training.fixer_job import CURVE_FILE, SCORES_FILE, WEIGHTS_FILE, FixerJob
from flows.training.fixer_pairs import VALIDATION_PAIRS, get_pairs, list_pair_scenes, list_validation_scenes
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import InputError
from genre_tasks.fixer.architectures import load_sd_turbo, small_architecture
from genre_tasks.fixer.training import train
from genre_tasks.fixer.training_checkpoint import CHECKPOINT_FILE
from genre_tasks.fixer.weight_files import check_described_weights
from genre_tasks.fixer.weights import load_fnet, save_fnet
from genre_tasks.progress import Progress, silent

if TYPE_CHECKING:
    import torch

    from genre_tasks.fixer.network import Fnet
    from genre_tasks.fixer.pairs import Pairs

RANK = 16
"""Rank of the LoRA adapters on SD-Turbo."""


@dataclass(frozen=True)
class FixerScores:
    """Scores of a fixer on validation streets at ± 3 m, each a mean over views.

    Attributes:
        views: how many views.
        psnr_render: PSNR of the renders against the truth in dB.
        psnr_fixed: the same of the fixed images.
        perceptual_render: perceptual distance of the renders to the truth; 0 is equal.
        perceptual_fixed: the same of the fixed images.
        psnr_identity: PSNR in dB of true images that were given as renders: what a fixer does to a clean image.
    """

    views: int
    psnr_render: float
    psnr_fixed: float
    perceptual_render: float
    perceptual_fixed: float
    psnr_identity: float


def load_pairs(job: FixerJob, progress: Progress = silent) -> Pairs:
    """Loads all pairs of a training; what the store lacks is made.

    Args:
        job: the training.
        progress: called with each scene's number, their count and its log.

    Returns:
        The pairs of all scenes, on the CPU.

    Raises:
        ConfigError: there is nothing to make pairs of, or a chunk is not for training.
    """
    from genre_tasks.fixer.pairs import concatenate_pairs

    scenes = list_pair_scenes(job.streets, job.real)
    parts = []
    for k, scene in enumerate(scenes):
        progress(k, len(scenes), scene.uri)
        parts.append(get_pairs(job.store, scene))
    return concatenate_pairs(parts)


def kind_fractions(pairs: Sequence[tuple[str, float]]) -> dict[str, float]:
    """Computes which fraction of pairs is of which kind.

    Args:
        pairs: kind and lateral shift in metres of each pair.

    Returns:
        Kind → fraction; also ``optimiser``: renders of an optimiser's own output, and ``lateral``: shifted views.

    >>> kind_fractions([("beside", 3.0), ("beside", -1.0), ("sparse", 0.0), ("perturbed", 3.0)])
    {'beside': 0.5, 'perturbed': 0.25, 'sparse': 0.25, 'optimiser': 0.75, 'lateral': 0.75}
    """
    kinds = [kind for kind, _ in pairs]
    fractions = {kind: kinds.count(kind) / len(kinds) for kind in sorted(set(kinds))}
    lateral = sum(shift != 0 for _, shift in pairs) / len(kinds)
    return {**fractions, "optimiser": 1 - fractions.get("perturbed", 0.0), "lateral": lateral}


def train_fixer(job: FixerJob, progress: Progress = silent) -> tuple[Path, bool]:
    """Trains FNet to the end of its preset; goes on from the checkpoint in ``job.run_folder``.

    At each checkpoint it writes ``fnet.safetensors`` with its JSON, ``curve.parquet`` (a row for each step) and, with
    ``job.validate``, a sample picture and the scores.

    Args:
        job: the training.
        progress: called with scenes while pairs are loaded, then with steps.

    Returns:
        (path of the weights, whether anything was left to train).

    Raises:
        InputError: the checkpoint is of other settings, pairs or initial weights, those have other inputs, or another
            process trains in the folder.
    """
    with hold_training_folder(job.run_folder):
        return _train_to_end(job, progress)


def _train_to_end(job: FixerJob, progress: Progress) -> tuple[Path, bool]:
    from genre_tasks.fixer.pairs import concatenate_pairs
    from genre_tasks.metrics.perceptual import perceptual_distance

    folder = job.run_folder
    pairs = load_pairs(job, progress)
    validation = None
    if job.validate:
        scenes = list_validation_scenes()
        validation = concatenate_pairs([get_pairs(job.store, scene, VALIDATION_PAIRS) for scene in scenes])
    initial = _load_initial(job)
    # Scores without a checkpoint are of a training that was deleted since.
    if not (folder / CHECKPOINT_FILE).is_file():
        (folder / SCORES_FILE).unlink(missing_ok=True)
    recorder = _CheckpointRecorder(job, validation)
    fnet = train(
        pairs,
        job.settings,
        folder,
        perceptual_distance(),
        progress=progress,
        on_checkpoint=recorder,
        architecture=replace(small_architecture(), inputs=tuple(job.inputs.split("+"))),
        start=initial,
        autoencoder=Path(job.folder) / "fnet",
    )
    # Weights may have been deleted or damaged after the last checkpoint, which still has them.
    weights = folder / WEIGHTS_FILE
    if not _are_sound(weights, job):
        recorder.save(fnet)
    return weights, recorder.is_trained


def _are_sound(weights: Path, job: FixerJob) -> bool:
    """Whether the files of the weights are there, complete and as the job writes them, as far as headers tell."""
    try:
        _, described = check_described_weights(weights, "small" if job.sd_turbo is None else "sd-turbo")
    except InputError:
        return False
    return job.sd_turbo is None or _is_base_found(described.get("base"), weights.parent, job)


def _is_base_found(base: object, folder: Path, job: FixerJob) -> bool:
    """Whether a run finds SD-Turbo by what the adapters in a folder call it."""
    if base == job.adapters_base:
        return True
    if not isinstance(base, str) or job.sd_turbo is None:
        return False
    found = folder / base
    # An older version wrote relative paths as they were typed, which start from another folder than the adapters'.
    is_same = found.resolve() == Path(job.sd_turbo).resolve()
    return found.is_dir() and (is_same or Path(base).is_absolute())


def require_same_inputs(inputs: Sequence[str], job: FixerJob, path: Path) -> None:
    """Refuses weights to start from that were trained with other inputs.

    Args:
        inputs: of the weights.
        job: the training.
        path: of the weights, for the error.

    Raises:
        InputError: the inputs differ.
    """
    # The first layer's shape follows from the inputs, so other weights would fail with a less helpful error.
    if tuple(inputs) != tuple(job.inputs.split("+")):
        raise InputError("the weights to start from have other inputs", remedy="Give the same.", file=path)


def _load_initial(job: FixerJob) -> Fnet | None:
    if job.sd_turbo is not None:
        return load_sd_turbo(job.sd_turbo, rank=RANK)
    path = job.initial_weights
    if path is None:
        return None
    fnet = load_fnet(path)
    require_same_inputs(fnet.architecture.inputs, job, path)
    return fnet


class _CheckpointRecorder:
    """Writes weights, curve and scores at each checkpoint of a training."""

    def __init__(self, job: FixerJob, validation: Pairs | None) -> None:
        self.is_trained = False
        self._folder = job.run_folder
        self._base = job.adapters_base
        self._validation = validation
        # Without a checkpoint a curve is of a training that was deleted since.
        has_checkpoint = (self._folder / CHECKPOINT_FILE).is_file()
        self._rows = load_rows(self._folder / CURVE_FILE, FIXER_CURVE) if has_checkpoint else []
        self._began = time.perf_counter()

    def __call__(self, fnet: Fnet, step: int, losses: Sequence[float]) -> None:
        self.is_trained = True
        # All of this comes before the checkpoint: what a kill leaves out is made again on resuming.
        self.save(fnet)
        # Rows after the checkpoint that was resumed are of steps that are made again.
        known = [row for row in self._rows if row["step"] < step][: len(losses)]
        # Steps are not timed one by one: the time since the last checkpoint is divided among them.
        seconds = (time.perf_counter() - self._began) / max(1, len(losses) - len(known))
        new = [{"step": k, "loss": losses[k], "seconds": seconds} for k in range(len(known), len(losses))]
        self._rows = known + new
        save_rows(self._folder / CURVE_FILE, FIXER_CURVE, self._rows)
        if self._validation is not None:
            save_sample_picture(fnet, self._validation, self._folder / f"sample-{step:06d}.png")
            path = self._folder / SCORES_FILE
            rows = [row for row in load_rows(path, FIXER_SCORES) if row["step"] < step]
            # Rows from here on are of a checkpoint that was not completed: its steps are made again.
            scores = {"step": step, **asdict(score_fixer(fnet, self._validation))}
            save_rows(path, FIXER_SCORES, [*rows, scores])
        self._began = time.perf_counter()

    def save(self, fnet: Fnet) -> None:
        """Writes the weights: all of a small network's, or the adapters on SD-Turbo."""
        save_fnet(fnet, self._folder / WEIGHTS_FILE, self._base, None if self._base is None else RANK)


def score_fixer(fnet: Fnet, pairs: Pairs, seed: int = 0) -> FixerScores:
    """Scores a fixer on pairs.

    Args:
        fnet: the fixer.
        pairs: renders and true images.
        seed: of the fixer's noise.

    Returns:
        Means over the pairs.
    """
    from genre_tasks.fixer.inference import draw_noise, fix
    from genre_tasks.metrics.perceptual import perceptual_distance

    distance = perceptual_distance()
    scores = []
    # One at a time, so that the batch does not change the numbers.
    for k in range(len(pairs)):
        views, truth = pairs.as_floats(slice(k, k + 1))
        noise = draw_noise(fnet, seed, range(k, k + 1), *truth.shape[-2:])
        fixed = fix(fnet, views, noise)
        clean = fix(fnet, replace(views, color=truth, alpha=views.alpha * 0 + 1), noise)
        render_last, fixed_last, truth_last = (image.permute(0, 2, 3, 1) for image in (views.color, fixed, truth))
        scores.append(
            [
                _psnr(views.color, truth),
                _psnr(fixed, truth),
                float(distance(render_last, truth_last)),
                float(distance(fixed_last, truth_last)),
                _psnr(clean, truth),
            ]
        )
    psnr_render, psnr_fixed, perceptual_render, perceptual_fixed, psnr_identity = np.mean(scores, 0).tolist()
    return FixerScores(
        views=len(pairs),
        psnr_render=psnr_render,
        psnr_fixed=psnr_fixed,
        perceptual_render=perceptual_render,
        perceptual_fixed=perceptual_fixed,
        psnr_identity=psnr_identity,
    )


def save_sample_picture(fnet: Fnet, pairs: Pairs, path: Path, rows: int = 6, seed: int = 0) -> None:
    """Writes a picture of some pairs: render, LiDAR map, images warped by the depth of each, fixed, truth.

    Args:
        fnet: the fixer.
        pairs: the pairs to choose from, evenly spaced.
        path: the PNG file to write.
        rows: how many pairs at most.
        seed: of the fixer's noise.
    """
    import torch
    from PIL import Image

    from genre_tasks.fixer.inference import draw_noise, fix

    lines = []
    for k in np.linspace(0, len(pairs) - 1, min(rows, len(pairs))).astype(int).tolist():
        views, truth = pairs.as_floats(slice(k, k + 1))
        fixed = fix(fnet, views, draw_noise(fnet, seed, range(k, k + 1), *truth.shape[-2:]))
        lines.append(torch.cat([views.color, views.lidar_color, views.warped, views.lidar_warped, fixed, truth], -1))
    image = (torch.cat(lines, -2)[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    with atomic_path(path) as temporary:
        Image.fromarray(image).save(temporary, "PNG")


def _psnr(image: torch.Tensor, truth: torch.Tensor) -> float:
    # In single precision and without the checks of `genre_tasks.metrics`, as scores in the model card were measured.
    # The floor keeps equal images from an infinite PSNR, which would hide the others in a mean.
    return float(-10 * (image - truth).square().mean().clamp_min(1e-10).log10())
