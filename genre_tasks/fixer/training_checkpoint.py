"""Checkpoints of the fixer's training: they hold everything that the next step depends on.

A resumed training takes the same steps as one that was never stopped. It is refused where settings, pairs or starting
weights are other ones.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from genre_tasks.atomic_path import write_atomically
from genre_tasks.errors import InputError
from genre_tasks.fixer.network import Fnet, FnetArchitecture
from genre_tasks.fixer.training_settings import AUTOENCODER_SETTINGS, TrainingSettings
from genre_tasks.fixer.weights import trainable_state

CHECKPOINT_FILE = "fixer.pt"
AUTOENCODER_FILE = "autoencoder.pt"
REMEDY = "Delete it to train again, or train into another folder."
_STATE_FIELDS = ("settings", "weights", "average", "optimiser", "generator", "step", "losses")


@dataclass
class TrainingState:
    """Everything that the next step depends on.

    Attributes:
        fnet: the network that is trained.
        average: running mean of the weights that are trained, by name.
        optimiser: with its moments.
        generator: of crops and noise.
        step: number of steps done.
        losses: one for each step done.
    """

    fnet: Fnet
    average: dict[str, Tensor]
    optimiser: torch.optim.Optimizer
    generator: torch.Generator
    step: int
    losses: list[float]


@dataclass(frozen=True)
class TrainedAutoencoder:
    """The result of the first part of training.

    Attributes:
        scaling_factor: brings latents to unit variance.
        weights: of the whole network, by name.
    """

    scaling_factor: float
    weights: dict[str, Tensor]


def save_checkpoint(state: TrainingState, path: Path, settings: TrainingSettings, origin: Mapping[str, str]) -> None:
    """Writes a checkpoint; a kill leaves the last complete one.

    Args:
        state: to continue from.
        path: of the file.
        settings: of the training.
        origin: what else the training depends on: name → digest.
    """
    document = {
        "settings": settings.as_plain(),
        "origin": dict(origin),
        "weights": {name: value.detach() for name, value in trainable_state(state.fnet).items()},
        "average": state.average,
        "optimiser": state.optimiser.state_dict(),
        # With the generator's state a resumed training draws the crops and the noise that would have come next.
        "generator": state.generator.get_state(),
        "step": state.step,
        "losses": state.losses,
    }
    _write(document, path)


def restore_checkpoint(state: TrainingState, path: Path, settings: TrainingSettings, origin: Mapping[str, str]) -> None:
    """Continues from a checkpoint, if there is one.

    Args:
        state: at the beginning of the training; changed in place.
        path: of the file.
        settings: of the training.
        origin: what else the training depends on: name → digest.

    Raises:
        InputError: the checkpoint is of other settings, pairs or starting weights, or cannot be read.
    """
    if not path.exists():
        return
    stored = _read(path, _STATE_FIELDS)
    _require_same_settings(stored["settings"], settings, path, tuple(settings.as_plain()))
    _require_same_origin(stored, origin, path)
    # Frozen weights are not in the checkpoint: they follow from the start, whose digest was compared.
    state.fnet.load_state_dict(stored["weights"], strict=False)
    state.average = stored["average"]
    state.optimiser.load_state_dict(stored["optimiser"])
    state.generator.set_state(stored["generator"])
    state.step = stored["step"]
    state.losses = stored["losses"]


def count_steps(path: Path) -> tuple[int, int]:
    """Reads how far a training has come.

    Args:
        path: of its checkpoint.

    Returns:
        Steps that are done, and all of them.

    Raises:
        InputError: the checkpoint cannot be read.
    """
    # Mapped, as most of a checkpoint is weights and moments.
    stored = _read(path, ("settings", "step"), mmap=True)
    return int(stored["step"]), int(stored["settings"]["steps"])


def save_autoencoder(
    autoencoder: TrainedAutoencoder, path: Path, settings: TrainingSettings, origin: Mapping[str, str]
) -> None:
    """Writes the result of the first part, which trainings on other inputs may share.

    Args:
        autoencoder: to write.
        path: of the file.
        settings: of the training.
        origin: what else it depends on: name → digest.
    """
    document = {
        "settings": settings.as_plain(),
        "origin": dict(origin),
        "scale": autoencoder.scaling_factor,
        "weights": autoencoder.weights,
    }
    _write(document, path)


def load_autoencoder(path: Path, settings: TrainingSettings, origin: Mapping[str, str]) -> TrainedAutoencoder | None:
    """Reads the result of the first part.

    Args:
        path: of the file.
        settings: of the training; those of ``AUTOENCODER_SETTINGS`` count.
        origin: what else it depends on: name → digest.

    Returns:
        ``None`` where there is no file.

    Raises:
        InputError: it was trained with other settings, on other pairs or of another architecture, or cannot be read.
    """
    # Fixers of several inputs share the first part, which is the same for all of them.
    if not path.exists():
        return None
    stored = _read(path, ("settings", "scale", "weights"))
    _require_same_settings(stored["settings"], settings, path, AUTOENCODER_SETTINGS)
    _require_same_origin(stored, origin, path, may_lack=("architecture",))
    return TrainedAutoencoder(stored["scale"], stored["weights"])


def digest_weights(fnet: Fnet) -> str:
    """Digests a network's inputs and all its weights.

    Args:
        fnet: the network.

    Returns:
        A SHA-256.
    """
    # The inputs count because a network on other inputs may have the same weights.
    digest = hashlib.sha256("+".join(fnet.architecture.inputs).encode())
    for name, value in sorted(fnet.state_dict().items()):
        digest.update(name.encode() + value.detach().contiguous().numpy().tobytes())
    return digest.hexdigest()


def digest_architecture(architecture: FnetArchitecture) -> str:
    """Digests the configurations of an architecture's two models, which its weights are made for.

    Args:
        architecture: of the network.

    Returns:
        A SHA-256.
    """
    # Without the inputs: networks of several inputs share the first part of training.
    described = json.dumps([architecture.vae, architecture.unet], sort_keys=True)
    return hashlib.sha256(described.encode()).hexdigest()


def _write(document: dict[str, Any], path: Path) -> None:
    # Through memory, because torch writes the file's name into the file: that of a temporary one would differ each
    # time.
    buffer = io.BytesIO()
    torch.save(document, buffer)
    write_atomically(path, buffer.getvalue())


def _read(path: Path, fields: Sequence[str], mmap: bool = False) -> dict[str, Any]:
    try:
        stored = torch.load(path, weights_only=True, mmap=mmap)
    except Exception as error:  # what torch raises of a damaged file has no common class
        # The file may be sound: torch has no class for a lack of memory either.
        if isinstance(error, MemoryError) or "alloc" in str(error):
            raise
        # Not torch's text, which recommends to let the file run code.
        detail = f": {error.strerror}" if isinstance(error, OSError) and error.strerror else ""
        raise InputError(f"the checkpoint cannot be read{detail}", remedy=REMEDY, file=path) from error
    if not isinstance(stored, dict) or not set(fields) <= stored.keys():
        raise InputError("the file is no checkpoint of this training", remedy=REMEDY, file=path)
    return stored


def _require_same_settings(
    stored: Mapping[str, Any], settings: TrainingSettings, path: Path, names: Sequence[str]
) -> None:
    now = settings.as_plain()
    different = [name for name in names if stored.get(name) != now[name]]
    if different:
        raise InputError(
            f"the checkpoint was trained with other settings: {', '.join(different)}",
            remedy="Train with the same settings, or into another folder.",
            file=path,
        )


def _require_same_origin(
    stored: Mapping[str, Any], origin: Mapping[str, str], path: Path, may_lack: Sequence[str] = ()
) -> None:
    known = stored.get("origin", {})
    # An entry that an older checkpoint lacks counts as different, unless it came later than files that are in use.
    different = [
        name for name, value in origin.items() if known.get(name) != value and (name in known or name not in may_lack)
    ]
    if different:
        raise InputError(
            f"the checkpoint was trained with other {' and '.join(different)}",
            remedy="Delete it, or train into another folder.",
            file=path,
        )
