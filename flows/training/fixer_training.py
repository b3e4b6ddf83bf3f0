"""Training of FNet as plain functions: its pairs, the network, its scores on validation streets."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flows.training.fixer_pairs import VALIDATION, pair_scenes, pairs_of, validation_scenes
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.fixer.network import INPUTS, sd_turbo, small_architecture
from genre_tasks.fixer.training import CHECKPOINT, FOLLOWS, PRESETS, TrainingSettings, train
from genre_tasks.fixer.weights import load_fnet, save_fnet
from genre_tasks.progress import Progress, silent
from flows.training.curve_table import FIXING, FIXING_SCORES, read_rows, write_rows
from storage.local import LocalStore

if TYPE_CHECKING:
    import torch

    from genre_tasks.fixer.network import Fnet
    from genre_tasks.fixer.pairs import Pairs

CURVE, SCORES, WEIGHTS = "curve.parquet", "validation.parquet", "fnet.safetensors"
RANK = 16
"""Of the LoRA adapters on SD-Turbo."""


@dataclass(frozen=True)
class FixerJob:
    """What a training of FNet is told: plain values.

    ``folder`` holds the store of scenes and pairs and a folder for each set of inputs. ``real``: the URI of a log whose
    chunk 0 is trained on. ``streets``: how many synthetic streets. ``inputs``: what the fixer is given, joined by "+".
    ``preset``: small, further and last (from the weights of the one before or from ``start``) or paper (from SD-Turbo,
    at ``start``).
    ``validate``: score on validation streets at each checkpoint, with a picture.
    """

    folder: str
    real: str | None = None
    streets: int = 28
    inputs: str = "+".join(INPUTS)
    preset: str = "small"
    start: str | None = None
    steps: int | None = None
    validate: bool = False

    def __post_init__(self) -> None:
        stray = sorted(set(self.inputs.split("+")) - set(INPUTS))
        if stray:
            raise ConfigError(f"no input is called {' or '.join(stray)}", remedy=f"Join by +: {', '.join(INPUTS)}.")
        if self.preset not in PRESETS:
            raise ConfigError(f"no preset is called {self.preset!r}", remedy=f"Known: {', '.join(PRESETS)}.")
        if self.preset == "paper" and self.start is None:
            raise ConfigError(
                "the paper's fixer starts from SD-Turbo",
                remedy="Give a folder with its vae and unet in diffusers' layout, or a hub id, by --start.",
            )

    @property
    def store(self) -> LocalStore:
        """Where scenes and pairs are kept."""
        return LocalStore(Path(self.folder) / "store")

    @property
    def place(self) -> Path:
        """The training's folder."""
        parts = ["fnet", *([] if self.inputs == "+".join(INPUTS) else [self.inputs])]
        return Path(self.folder) / "-".join([*parts, *([] if self.preset == "small" else [self.preset])])

    @property
    def settings(self) -> TrainingSettings:
        """The preset's, with the job's length."""
        settings = PRESETS[self.preset]
        return settings if self.steps is None else replace(settings, steps=self.steps)


@dataclass(frozen=True)
class Scores:
    """Means over views at ± 3 m of validation streets: render and fixed against the truth; ``identity``: the truth as
    the render, fixed.
    """

    views: int
    psnr_render: float
    psnr_fixed: float
    perceptual_render: float
    perceptual_fixed: float
    psnr_identity: float


def load_pairs(job: FixerJob, progress: Progress = silent) -> Pairs:
    """All pairs of the job; what the store lacks is made."""
    from genre_tasks.fixer.pairs import joined

    scenes = pair_scenes(job.streets, job.real)
    parts = []
    for k, scene in enumerate(scenes):
        progress(k, len(scenes), scene.uri)
        parts.append(pairs_of(job.store, scene))
    return joined(parts)


def shares(pairs: Sequence[tuple[str, float]]) -> dict[str, float]:
    """Of pairs' kinds and shifts: the share of each kind, of the ``optimiser``'s own output, of ``lateral`` shifts."""
    kinds = [kind for kind, _ in pairs]
    out = {kind: kinds.count(kind) / len(kinds) for kind in sorted(set(kinds))}
    lateral = sum(shift != 0 for _, shift in pairs) / len(kinds)
    return {**out, "optimiser": 1 - out.get("perturbed", 0.0), "lateral": lateral}


def train_fixer(job: FixerJob, progress: Progress = silent) -> tuple[Path, bool]:
    """Trains FNet to the end of its preset; goes on from the checkpoint in ``job.place``.

    Returns the weights' path, and whether anything was left to train. Raises ``InputError`` where the checkpoint is of
    other settings, pairs or weights to start from.

    Writes there at each checkpoint ``fnet.safetensors`` with its JSON, ``curve.parquet`` (a row for each step) and,
    with ``job.validate``, a sample picture and the scores.
    """
    from genre_tasks.fixer.pairs import joined
    from genre_tasks.metrics.perceptual import perceptual_distance

    folder, settings = job.place, job.settings
    pairs = load_pairs(job, progress)
    validation = None
    if job.validate:
        validation = joined([pairs_of(job.store, scene, VALIDATION) for scene in validation_scenes()])
    began, trained = time.perf_counter(), False
    rows = read_rows(folder / CURVE, FIXING) if (folder / CHECKPOINT).is_file() else []  # else of one since deleted
    base = job.start if job.preset == "paper" else None

    def save(fnet: Fnet) -> None:
        save_fnet(fnet, folder / WEIGHTS, base, None if base is None else RANK)

    def checkpoint(fnet: Fnet, step: int, losses: Sequence[float]) -> None:
        nonlocal began, trained
        trained = True
        save(fnet)
        known = [row for row in rows if row["step"] < step][: len(losses)]
        each = (time.perf_counter() - began) / max(1, len(losses) - len(known))
        new = [{"step": k, "loss": losses[k], "seconds": each} for k in range(len(known), len(losses))]
        rows[:] = known + new
        write_rows(folder / CURVE, FIXING, rows)
        if validation is not None:
            save_picture(fnet, validation, folder / f"sample-{step:06d}.png")
            scores = [row for row in read_rows(folder / SCORES, FIXING_SCORES) if row["step"] < step]
            write_rows(folder / SCORES, FIXING_SCORES, [*scores, {"step": step, **asdict(score(fnet, validation))}])
        began = time.perf_counter()

    start, architecture = None, replace(small_architecture(), inputs=tuple(job.inputs.split("+")))
    before = job.start
    if job.preset in FOLLOWS and before is None:
        before = str(replace(job, preset=FOLLOWS[job.preset]).place / WEIGHTS)
    if base is not None:
        start = sd_turbo(base, rank=RANK)
    elif before is not None:
        start = load_fnet(Path(before))
        if start.architecture.inputs != architecture.inputs:
            raise InputError("the weights to start from have other inputs", remedy="Give the same.", file=Path(before))
    fnet = train(
        pairs,
        settings,
        folder,
        perceptual_distance(),
        progress,
        checkpoint,
        architecture,
        start,
        Path(job.folder) / "fnet",
    )
    if not (folder / WEIGHTS).is_file():  # deleted since
        save(fnet)
    return folder / WEIGHTS, trained


def score(fnet: Fnet, pairs: Pairs, seed: int = 0) -> Scores:
    """PSNR (dB) and perceptual distance to the truth, before and after fixing; PSNR of a clean image that is fixed."""
    from genre_tasks.fixer.inference import fix, noise_of
    from genre_tasks.metrics.perceptual import perceptual_distance

    distance = perceptual_distance()
    rows = []
    for k in range(len(pairs)):
        views, truth = pairs.at(slice(k, k + 1))
        noise = noise_of(fnet, seed, range(k, k + 1), *truth.shape[-2:])
        clean = replace(views, color=truth, alpha=views.alpha * 0 + 1)
        fixed, same = fix(fnet, views, noise), fix(fnet, clean, noise)
        last = [x.permute(0, 2, 3, 1) for x in (views.color, fixed, truth)]
        rows.append(
            [_psnr(views.color, truth), _psnr(fixed, truth), float(distance(last[0], last[2])),
             float(distance(last[1], last[2])), _psnr(same, truth)]
        )
    return Scores(len(pairs), *(float(x) for x in np.mean(rows, 0)))


def save_picture(fnet: Fnet, pairs: Pairs, path: Path, rows: int = 6, seed: int = 0) -> None:
    """A picture of some pairs: render | LiDAR map | images by rendered depth | by the map's | fixed | truth."""
    import torch
    from PIL import Image

    from genre_tasks.fixer.inference import fix, noise_of

    lines = []
    for k in np.linspace(0, len(pairs) - 1, min(rows, len(pairs))).astype(int).tolist():
        views, truth = pairs.at(slice(k, k + 1))
        fixed = fix(fnet, views, noise_of(fnet, seed, range(k, k + 1), *truth.shape[-2:]))
        lines.append(torch.cat([views.color, views.lidar_color, views.warped, views.lidar_warped, fixed, truth], -1))
    image = (torch.cat(lines, -2)[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    temporary = path.with_name(f".{path.name}")
    Image.fromarray(image).save(temporary, "PNG")
    temporary.replace(path)


def _psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(-10 * (a - b).square().mean().clamp_min(1e-10).log10())
