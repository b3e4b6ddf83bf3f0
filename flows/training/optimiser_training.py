"""Meta-training of GNet and ENet as a function: checkpoints, weights, a learning curve; and what it is scored by."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from flows.training import checkpoint
from flows.training.curve_plot import read_curve, write_curve
from genre_tasks.config import LossConfig
from genre_tasks.errors import InputError
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.losses.rendering_loss import Distance
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.losses.targets import Target
from genre_tasks.learned.meta_training import MetaConfig, MetaTraining
from genre_tasks.optimiser.unroll import Plan, unroll
from genre_tasks.learned.weights import load, save, with_residuals
from genre_tasks.progress import Progress, silent
from genre_tasks.render.api import render_views
from genre_tasks.scene.graph import SceneGraph

CHECKPOINT, WEIGHTS = "checkpoint.safetensors", "weights.safetensors"


@dataclass(frozen=True)
class Score:
    """Mean PSNR in dB of a scene on views of one kind, and how many they are."""

    heldout: float
    novel: float
    views: int


def network_from(
    config: NetworkConfig, seed: int, weights: Path | None = None, new_head: bool = False
) -> LearnedOptimiser:
    """A new network, or one that starts from ``weights`` with the rates and, if any, residuals of ``config``.

    ``new_head``: its last layer is a new one, so that its first step is tuned Adam's.

    Raises ``InputError`` for weights that are missing, unreadable, or of a network of another shape.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = LearnedOptimiser(config)
    if weights is not None:
        start = load(weights)
        may = {"rates", "relaxation"} | ({"residuals"} if config.residuals else set())
        other = {name for name, value in config if name not in may and value != getattr(start.config, name)}
        if other:
            raise InputError(
                f"The weights to start from are of a network with other {' and '.join(sorted(other))}",
                remedy="Start from weights of the same network, or from none.",
                file=weights,
            )
        values = with_residuals(start) if config.residuals else start.state_dict()
        if new_head:
            values |= {name: value for name, value in network.state_dict().items() if name.startswith("head.")}
        network.load_state_dict(values)
    return network


def train_optimiser(
    network: LearnedOptimiser,
    scenes: Sequence[TrainingScene],
    config: MetaConfig,
    folder: Path,
    distance: Distance | None = None,
    save_every: int = 50,
    watch: Callable[[int, LearnedOptimiser], None] | None = None,
    progress: Progress = silent,
    origin: Mapping[str, str] | None = None,
) -> LearnedOptimiser:
    """Meta-trains for ``config.steps`` weight updates; goes on from ``folder`` where it was interrupted.

    Writes there ``curve.parquet`` (a row for each update) with its picture, ``weights.safetensors`` with its JSON, and
    last ``checkpoint.safetensors``. ``watch`` is called at each checkpoint, for validation; ``origin`` as for
    :func:`flows.training.checkpoint.save`. Raises ``InputError`` where the folder holds another training.
    """
    training = MetaTraining(network, scenes, config, distance)
    path = folder / CHECKPOINT
    folder.mkdir(parents=True, exist_ok=True)
    if path.is_file():
        checkpoint.resume(training, path, origin)
    rows = read_curve(folder, training.done)
    while training.done < config.steps:
        began = time.perf_counter()
        record = training.step()
        rows.append({**asdict(record), "seconds": time.perf_counter() - began})
        progress(training.done, config.steps, f"unseen loss {record.judged_loss:.3f}")
        if training.done % save_every == 0 or training.done == config.steps:
            write_curve(folder, rows)
            save(training.network, folder / WEIGHTS)
            if watch is not None:  # before the checkpoint: what a kill leaves out is made again
                watch(training.done, training.network)
            checkpoint.save(training, path, origin)
    if not path.is_file():  # no update at all: what it starts from, at the rates of its own configuration
        write_curve(folder, rows)
        save(training.network, folder / WEIGHTS)
        checkpoint.save(training, path, origin)
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
