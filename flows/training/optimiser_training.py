"""Meta-training of GNet and ENet as a function: checkpoints, weights and a learning curve; and what it is scored by."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from flows.training import checkpoint
from flows.training.curve_plot import read_curve, save_curve
from genre_tasks.config import LossConfig
from genre_tasks.effects.color_gain import apply_gain
from genre_tasks.errors import InputError
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.meta_episodes import TrainingScene
from genre_tasks.learned.meta_training import MetaConfig, MetaTraining
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.learned.weights import add_residual_inputs, load_optimiser, save_optimiser
from genre_tasks.losses.rendering_loss import ImageDistance
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.progress import Progress, silent
from genre_tasks.render.api import render_views
from genre_tasks.scene.graph import SceneGraph

CHECKPOINT_FILE = "checkpoint.safetensors"
WEIGHTS_FILE = "weights.safetensors"


@dataclass(frozen=True)
class OptimisationScore:
    """How well a scene shows views that its optimiser was not shown.

    Attributes:
        heldout: mean PSNR over held-out views in dB.
        novel: mean PSNR over true novel views in dB; NaN where there are none.
        views: how many held-out views there are.
    """

    heldout: float
    novel: float
    views: int


def initialise_network(
    config: NetworkConfig, seed: int, weights: Path | None = None, new_head: bool = False
) -> LearnedOptimiser:
    """Makes a new network, or one that starts from trained weights.

    Args:
        config: the network's shape, learning rates and, if any, residuals.
        seed: of the new weights.
        weights: a file of weights to start from.
        new_head: the last layer is new all the same, so that the network's first step is tuned Adam's, besides what
            image residuals add.

    Returns:
        The network on the CPU.

    Raises:
        InputError: the weights are missing, unreadable, or of a network of another shape.
    """
    # Apart from the global generator, whose state must not depend on whether a network was made.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = LearnedOptimiser(config)
    if weights is None:
        return network
    start = load_optimiser(weights)
    # These are not weights: a stage may set them anew.
    may_differ = {"rates", "relaxation"} | ({"residuals"} if config.residuals else set())
    different = {name for name, value in config if name not in may_differ and value != getattr(start.config, name)}
    if different:
        raise InputError(
            f"The weights to start from are of a network with other {' and '.join(sorted(different))}",
            remedy="Start from weights of the same network, or from none.",
            file=weights,
        )
    values = add_residual_inputs(start) if config.residuals else start.state_dict()
    if new_head:
        # A new last layer gives no correction, so training begins at tuned Adam and not at an old network's habits.
        values |= {name: value for name, value in network.state_dict().items() if name.startswith("head.")}
    network.load_state_dict(values)
    return network


def train_optimiser(
    network: LearnedOptimiser,
    scenes: Sequence[TrainingScene],
    config: MetaConfig,
    folder: Path,
    distance: ImageDistance | None = None,
    save_every: int = 50,
    on_checkpoint: Callable[[int, LearnedOptimiser], None] | None = None,
    progress: Progress = silent,
    origin: Mapping[str, str] | None = None,
) -> LearnedOptimiser:
    """Meta-trains a network to the end of its configuration; goes on from ``folder`` where it was interrupted.

    At each checkpoint it writes ``curve.parquet`` (a row for each update) with its plot, ``weights.safetensors`` with
    its JSON, and last ``checkpoint.safetensors``.

    Args:
        network: the network to train, on the device to train on.
        scenes: what it is trained on, on the same device.
        config: length and settings of meta-training.
        folder: where everything is written.
        distance: perceptual distance, for losses with such a term.
        save_every: weight updates between checkpoints.
        on_checkpoint: called with the updates done and the network at each checkpoint, for validation.
        progress: called after each update.
        origin: what else the training depends on: name → digest.

    Returns:
        The trained network, without gradients.

    Raises:
        InputError: the folder holds another training.
    """
    training = MetaTraining(network, scenes, config, distance)
    path = folder / CHECKPOINT_FILE
    folder.mkdir(parents=True, exist_ok=True)
    if path.is_file():
        checkpoint.resume(training, path, origin)
    # Later rows are of updates after the checkpoint, which are made again.
    rows = read_curve(folder, training.done)
    while training.done < config.steps:
        began = time.perf_counter()
        record = training.step()
        rows.append({**record.as_row(), "seconds": time.perf_counter() - began})
        progress(training.done, config.steps, f"unseen loss {record.held_out_loss:.3f}")
        if training.done % save_every == 0 or training.done == config.steps:
            save_curve(folder, rows)
            save_optimiser(training.network, folder / WEIGHTS_FILE)
            # Validation comes before the checkpoint: what a kill leaves out is then made again on resuming.
            if on_checkpoint is not None:
                on_checkpoint(training.done, training.network)
            checkpoint.save(training, path, origin)
    # Without any update the weights are those it starts from, at the learning rates of its own configuration.
    if not path.is_file():
        save_curve(folder, rows)
        save_optimiser(training.network, folder / WEIGHTS_FILE)
        checkpoint.save(training, path, origin)
    return training.network.eval().requires_grad_(False)


def score_rule(
    rule: StepRule, scene: TrainingScene, loss: LossConfig, plan: UnrollSettings, distance: ImageDistance | None
) -> OptimisationScore:
    """Optimises a scene by a step rule and scores it on views that the optimiser was not shown.

    Args:
        rule: the optimiser.
        scene: where it begins and what it is optimised towards.
        loss: the loss that the rule descends.
        plan: iterations and views.
        distance: perceptual distance, for a loss with such a term.

    Returns:
        The scores of the optimised scene.
    """
    result = unroll(rule, scene.scene, scene.source, scene.fixed, Objective(loss, distance), plan)
    return OptimisationScore(
        mean_psnr(result.scene, scene.heldout), mean_psnr(result.scene, scene.truth), len(scene.heldout)
    )


@torch.no_grad()
def mean_psnr(scene: SceneGraph, targets: Sequence[Target]) -> float:
    """Computes the mean PSNR of a scene's renders, at the targets' exposures and without the ego vehicle's pixels.

    Args:
        scene: the scene.
        targets: the true images of V views.

    Returns:
        Mean over views in dB, at most 100 for each; NaN for no view.
    """
    # A stack of nothing would raise, and NaN is what a table shows as a gap.
    if not targets:
        return float("nan")
    values = []
    for image, target in zip(render_views(scene, targets).color, targets, strict=True):
        shown = image if target.log_gain is None else apply_gain(image, image.new_tensor(target.log_gain))
        error = (shown.clamp(0, 1) - target.image.pixels).square()
        if target.ego_mask is not None:
            error = error[~target.ego_mask]
        # The floor of 100 dB keeps equal images from an infinite PSNR, which would hide the others in the mean.
        values.append(-10 * torch.log10(error.mean().clamp_min(1e-10)))
    return float(torch.stack(values).mean())
