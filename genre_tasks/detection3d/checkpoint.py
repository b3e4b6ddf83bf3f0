"""Checkpoints of the detector's training, from which it goes on to the same bytes as without an interruption."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from genre_tasks.checkpoint_files import read_checkpoint, write_checkpoint
from genre_tasks.detection3d.network import Detector3dNetwork
from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.errors import InputError
from genre_tasks.weight_checks import require_weights_fit

STAGE = "train detector"
ADAM_NAMES = ("step", "exp_avg", "exp_avg_sq")
REMEDY = "Delete it to train again, or train into another folder."
# How often a training is written down has no influence on it.
_FREE_SETTINGS = ("checkpoint_every",)


@dataclass
class DetectorTraining:
    """Everything that the next step depends on.

    Attributes:
        network: in training mode.
        optimiser: with its moments.
        step: number of steps done.
        losses: one for each step done.
    """

    network: Detector3dNetwork
    optimiser: torch.optim.Optimizer
    step: int = 0
    losses: list[float] = field(default_factory=list)


def save_checkpoint(training: DetectorTraining, path: Path, config: Detector3dConfig, examples_digest: str) -> None:
    """Writes a checkpoint as one file, complete or not at all.

    Args:
        training: between two steps.
        path: of the file; its folder is made where it is missing.
        config: of the training.
        examples_digest: of the training examples.
    """
    tensors = {f"weights.{name}": value for name, value in training.network.state_dict().items()}
    for name, parameter in training.network.named_parameters():
        # By name and not by index, so that a checkpoint does not depend on the order of parameters.
        for key, value in training.optimiser.state.get(parameter, {}).items():
            tensors[f"optimiser.{key}.{name}"] = torch.as_tensor(value)
    tensors["losses"] = torch.tensor(training.losses, dtype=torch.float64)
    description = {"step": training.step, "config": config.model_dump(mode="json"), "examples": examples_digest}
    write_checkpoint(path, tensors, description)


def restore_checkpoint(training: DetectorTraining, path: Path, config: Detector3dConfig, examples_digest: str) -> None:
    """Continues from a checkpoint, if there is one.

    Args:
        training: at its beginning; changed in place.
        path: of the file.
        config: of the training.
        examples_digest: of the training examples.

    Raises:
        InputError: the file is no checkpoint, is damaged, or is one of other images or settings.
    """
    if not path.exists():
        return
    description, tensors = read_checkpoint(path, REMEDY, STAGE)
    try:
        losses = tensors.pop("losses").tolist()
        step = int(description["step"])
        changed = _find_changes(description, config, examples_digest)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"the checkpoint cannot be read: {error}", remedy=REMEDY, file=path, stage=STAGE) from error
    if changed:
        problem = f"the checkpoint is of a training with other {', '.join(changed)}"
        raise InputError(problem, remedy=REMEDY, file=path, stage=STAGE)
    weights = {name.removeprefix("weights."): value for name, value in tensors.items() if name.startswith("weights.")}
    # Before anything is changed: a refused checkpoint leaves the training as it was.
    require_weights_fit(weights, training.network.state_dict(), path, REMEDY, STAGE)
    for name, _ in training.network.named_parameters():
        if any(f"optimiser.{key}.{name}" not in tensors for key in ADAM_NAMES):
            raise InputError(f"the checkpoint has no moments of {name}", remedy=REMEDY, file=path, stage=STAGE)
    training.network.load_state_dict(weights)
    for name, parameter in training.network.named_parameters():
        state = {key: tensors[f"optimiser.{key}.{name}"] for key in ADAM_NAMES}
        # In the layout of the weights, as the optimiser makes them: sums in another order have other last bits.
        training.optimiser.state[parameter] = {
            "step": state["step"],
            **{key: torch.empty_like(parameter.detach()).copy_(state[key]) for key in ADAM_NAMES[1:]},
        }
    training.step = step
    training.losses = losses


def _find_changes(description: dict[str, Any], config: Detector3dConfig, examples_digest: str) -> list[str]:
    stored = description["config"]
    now = config.model_dump(mode="json")
    changed = [name for name, value in now.items() if name not in _FREE_SETTINGS and stored.get(name) != value]
    return changed + (["images"] if description["examples"] != examples_digest else [])
