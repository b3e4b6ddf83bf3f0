"""Training of GNet and ENet as functions: scenes, meta-training with checkpoints, weights with a learning curve."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import torch

from flows.train import checkpoint
from flows.train.scenes import PreparedScene
from genre_tasks.config import LossConfig
from genre_tasks.optimiser.adam import TunedAdam
from genre_tasks.optimiser.episodes import TrainingScene
from genre_tasks.optimiser.learned import LearnedOptimiser, NetworkConfig
from genre_tasks.optimiser.loss import Distance
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.rules import StepRule
from genre_tasks.optimiser.targets import Target, of_source
from genre_tasks.optimiser.training import MetaConfig, MetaTraining, StepRecord
from genre_tasks.optimiser.unroll import Plan, unroll
from genre_tasks.optimiser.weights import save
from genre_tasks.progress import Progress, silent
from genre_tasks.render.api import render_views
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.results import Reconstruction

AGES = (24, 48, 96)
"""Iterations of tuned Adam after which per-scene scenes are taken for ENet's training."""


@dataclass(frozen=True)
class Score:
    """Mean PSNR in dB of a scene on views of one kind, and how many they are."""

    heldout: float
    novel: float
    views: int


def network_from(config: NetworkConfig, seed: int, weights: Path | None = None) -> LearnedOptimiser:
    """A new network, or one that starts from ``weights`` with the rates of ``config``."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = LearnedOptimiser(config)
    if weights is not None:
        network.load_state_dict(LearnedOptimiser.load(weights).state_dict())
    return network


def train_scenes(
    prepared: Sequence[PreparedScene], ages: Sequence[int] = AGES, seed: int = 0, progress: Progress = silent
) -> list[Reconstruction]:
    """Per-scene reconstructions by tuned Adam on the source views, scene k stopped after ``ages[k % len(ages)]``."""
    out = []
    loss = LossConfig(perceptual=0.0)
    for k, scene in enumerate(prepared):
        source = of_source(scene.chunk, depth=True)
        plan = Plan(ages[k % len(ages)], 6, seed=seed + k, stage="train_scenes")
        out.append(unroll(TunedAdam(), scene.start.scene, source, (), Objective(loss), plan))
        progress(k + 1, len(prepared), scene.chunk.log)
    return out


def train_optimiser(
    network: LearnedOptimiser,
    scenes: Sequence[TrainingScene],
    config: MetaConfig,
    folder: Path,
    distance: Distance | None = None,
    save_every: int = 50,
    watch: Callable[[int, LearnedOptimiser], None] | None = None,
    progress: Progress = silent,
) -> LearnedOptimiser:
    """Meta-trains for ``config.steps`` weight updates; goes on from ``folder`` where it was interrupted.

    Writes ``checkpoint.safetensors``, ``weights.safetensors`` with its JSON, and ``curve.csv`` (one row a step) there.
    ``watch`` is called at each checkpoint, for validation.
    """
    training = MetaTraining(network, scenes, config, distance)
    path, curve = folder / "checkpoint.safetensors", folder / "curve.csv"
    folder.mkdir(parents=True, exist_ok=True)
    if path.is_file():
        checkpoint.resume(training, path)
    rows = [row for row in _read_curve(curve) if int(row["step"]) < training.done]
    while training.done < config.steps:
        record = training.step()
        rows.append({k: str(v) for k, v in asdict(record).items()})
        progress(training.done, config.steps, f"unseen loss {record.judged_loss:.3f}")
        if training.done % save_every == 0 or training.done == config.steps:
            checkpoint.save(training, path)
            save(training.network, folder / "weights.safetensors")
            _write_curve(curve, rows)
            if watch is not None:
                watch(training.done, training.network)
    return training.network.eval().requires_grad_(False)


def score(rule: StepRule, scene: TrainingScene, loss: LossConfig, plan: Plan, distance: Distance | None) -> Score:
    """Unrolls ``rule`` on a scene and measures it on what it did not see."""
    result = unroll(rule, scene.scene, scene.source, scene.fixed, Objective(loss, distance), plan)
    return Score(psnr(result.scene, scene.heldout), psnr(result.scene, scene.truth), len(scene.heldout))


@torch.no_grad()
def psnr(scene: SceneGraph, targets: Sequence[Target]) -> float:
    """Mean PSNR in dB over views; NaN for none."""
    if not targets:
        return float("nan")
    truth = torch.stack([t.image.image for t in targets])
    error = (render_views(scene, targets).color.clamp(0, 1) - truth).square().mean((1, 2, 3)).clamp_min(1e-10)
    return float((-10 * torch.log10(error)).mean())


def plot_curve(curve: Path, picture: Path, window: int = 50) -> None:
    """The learning curve as a PNG: the unseen views' loss at each segment's end, over its mean, and its running mean.

    Each scene's losses are divided by that scene's mean, so that easy and hard streets can share an axis.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    rows = _read_curve(curve)
    scenes = [row["scene"] for row in rows]
    loss = np.array([float(row["judged_loss"]) for row in rows])
    for name in set(scenes):
        own = np.array([s == name for s in scenes])
        loss[own] /= loss[own].mean()
    figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
    axes.plot(loss, ".", markersize=2, alpha=0.4, label="a segment")
    if len(loss) >= window:
        mean = np.convolve(loss, np.ones(window) / window, "valid")
        axes.plot(np.arange(window - 1, len(loss)), mean, label=f"mean of {window}")
    axes.set(xlabel="weight updates", ylabel="loss on unseen views / scene's mean")
    axes.legend()
    figure.savefig(picture, dpi=120)
    plt.close(figure)


def _read_curve(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _write_curve(path: Path, rows: Sequence[dict[str, str]]) -> None:
    temporary = path.with_suffix(".tmp")
    with temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(StepRecord)])
        writer.writeheader()
        writer.writerows(rows)
    temporary.replace(path)
