"""Training of the detector from scratch, for a fixed number of steps whatever the number of images.

What is random in a step follows from the seed and the step's number alone. A resumed training therefore takes the same
steps as one that was never stopped, and a checkpoint needs no state of a generator.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from genre_tasks.checks import check_finite
from genre_tasks.detection3d.augmentation import Batch, apply_changes, draw_changes, jitter_colours, take_batch
from genre_tasks.detection3d.checkpoint import DetectorTraining, restore_checkpoint, save_checkpoint
from genre_tasks.detection3d.detector import Detector3d, build_network
from genre_tasks.detection3d.examples import TrainingExamples, build_examples
from genre_tasks.detection3d.losses import detection_loss
from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.detection3d.targets import build_targets
from genre_tasks.optimiser.step_rules import cosine_decay
from genre_tasks.progress import Progress, silent
from genre_tasks.threads import torch_threads
from genre_tasks.training_sets.labelled_images import LabelledImage

STAGE = "train detector"
_LONG_SEED = 1_000_003


def train_detector(
    images: Sequence[LabelledImage] | TrainingExamples,
    config: Detector3dConfig,
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> Detector3d:
    """Trains a detector from scratch.

    Args:
        images: labelled images, or examples that were made of some with the same settings.
        config: what it finds, and how long it learns.
        checkpoint: file to resume from where it is there, and to write to; ``None``: no checkpoints.
        progress: called with the steps done, their total, and the recent loss.

    Returns:
        The detector. The same images, settings and machine give the same weights.

    Raises:
        InputError: no image has a box that counts, or the checkpoint is of other images or settings.
        NonFiniteError: the training diverges.
    """
    examples = images if isinstance(images, TrainingExamples) else build_examples(images, config)
    network = build_network(config).train()
    training = DetectorTraining(network, _build_optimiser(network, config))
    if checkpoint is not None:
        digest = examples.digest()
        restore_checkpoint(training, checkpoint, config, digest)
    start_s = time.monotonic()
    first_step = training.step
    # One thread: the last bits do not depend on the number of cores.
    with torch_threads(1):
        while training.step < config.steps:
            take_step(training, examples, config)
            seconds_per_step = (time.monotonic() - start_s) / (training.step - first_step)
            recent = training.losses[-50:]
            minutes_left = seconds_per_step * (config.steps - training.step) / 60
            progress(training.step, config.steps, f"loss {sum(recent) / len(recent):.3f}, {minutes_left:.1f} min left")
            if checkpoint is not None and (
                training.step % config.checkpoint_every == 0 or training.step == config.steps
            ):
                save_checkpoint(training, checkpoint, config, digest)
    return Detector3d(network.eval().requires_grad_(False), config, tuple(training.losses))


def take_step(training: DetectorTraining, examples: TrainingExamples, config: Detector3dConfig) -> None:
    """Takes one gradient step.

    Args:
        training: changed in place.
        examples: to draw a batch from.
        config: of the training.

    Raises:
        NonFiniteError: the loss or its gradient is not finite.
    """
    step = training.step
    batch = draw_batch(examples, config, step)
    loss = compute_loss(training.network, batch, config)
    check_finite(loss, f"loss of step {step}", STAGE)
    factor = min(1.0, (step + 1) / config.warm_up) * cosine_decay(step, config.steps)
    # Set by hand instead of by a scheduler: a checkpoint then needs the number of steps and nothing else.
    for group in training.optimiser.param_groups:
        group["lr"] = config.learning_rate * factor
    training.optimiser.zero_grad()
    loss.backward()
    norm = nn.utils.clip_grad_norm_(training.network.parameters(), config.clip)
    check_finite(norm, f"gradient's norm of step {step}", STAGE)
    training.optimiser.step()
    training.step += 1
    training.losses.append(float(loss.detach()))


def draw_batch(examples: TrainingExamples, config: Detector3dConfig, step: int) -> Batch:
    """Draws the batch of a step: images in random order, each changed at random.

    Args:
        examples: to draw from; all are drawn once before one is drawn again.
        config: batch size, changes and seed.
        step: number of the step, from 0.

    Returns:
        The batch.
    """
    rows = []
    for position in range(step * config.batch, (step + 1) * config.batch):
        epoch, place = divmod(position, len(examples))
        # Drawn again for each position: it is quick, and needs no state.
        order = torch.randperm(len(examples), generator=_generator(config.seed, 2 * epoch))
        rows.append(order[place])
    generator = _generator(config.seed, 2 * step + 1)
    batch = apply_changes(take_batch(examples, torch.stack(rows)), draw_changes(config.batch, config, generator))
    return jitter_colours(batch, config.colour_jitter, generator)


def compute_loss(network: nn.Module, batch: Batch, config: Detector3dConfig) -> Tensor:
    """Computes the loss of a batch.

    Args:
        network: the detector's.
        batch: images with their objects.
        config: weights of the terms.

    Returns:
        The loss, differentiable.
    """
    targets = build_targets(batch, config)
    logits, features = network(batch.images, batch.lenses[:, 2:])
    found = network.regress(features, targets.images, targets.cells)  # type: ignore[operator]
    return detection_loss(logits, found, targets, config)


def _build_optimiser(network: nn.Module, config: Detector3dConfig) -> torch.optim.Optimizer:
    """AdamW; biases and the scales of norms do not decay."""
    matrices = [p for p in network.parameters() if p.ndim > 1]
    vectors = [p for p in network.parameters() if p.ndim <= 1]
    groups: list[dict[str, Any]] = [{"params": matrices}, {"params": vectors, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=config.learning_rate, weight_decay=config.weight_decay)


def _generator(seed: int, number: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed * _LONG_SEED + number)
