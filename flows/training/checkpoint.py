"""Checkpoints of meta-training, from which it goes on to the same bytes as without an interruption.

One file in safetensors holds the weights, Adam's state, the pool of episodes and the generator; its metadata describe
them in JSON. Names in the file are those of older versions where these differ, so that old checkpoints still resume.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from genre_tasks.checkpoint_files import read_checkpoint, read_description, write_checkpoint
from genre_tasks.errors import InputError
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.meta_episodes import Episode, EpisodeConfig
from genre_tasks.learned.meta_training import MetaTraining
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.optimiser.gradients import Gradients
from genre_tasks.optimiser.objective import LossAndGradients
from genre_tasks.weight_checks import require_weights_fit

STATE_NAMES = {
    "offsets": "offsets",
    "first": "first_moment",
    "second": "second_moment",
    "seen": "visit_count",
    "seen_now": "visible",
}
"""Name of a tensor in the file → attribute of ``State``."""

HELD_OUT_VIEWS = "judges"
"""What the file calls ``EpisodeConfig.held_out_views``."""

ADAM_NAMES = ("step", "exp_avg", "exp_avg_sq")
REMEDY = "Train with the same settings, or into an empty folder."
_READ_REMEDY = "Delete it to train the stage anew."


def save(training: MetaTraining, path: Path, origin: Mapping[str, str] | None = None) -> None:
    """Writes a checkpoint as one file, complete or not at all.

    Args:
        training: between two weight updates.
        path: of the file.
        origin: what else the training depends on, name → digest; :func:`resume` compares it.
    """
    tensors = {f"weights.{name}": value for name, value in training.network.state_dict().items()}
    for name, value in _adam_tensors(training):
        tensors[f"optimiser.{name}"] = value
    tensors["generator"] = training.generator.get_state()
    for i, episode in enumerate(training.pool):
        tensors |= {f"pool.{i}.{name}": value for name, value in _episode_tensors(episode).items()}
    description = {
        "done": training.done,
        **_describe_settings(training),
        "origin": dict(origin or {}),
        "pool": [_describe_episode(episode) for episode in training.pool],
    }
    write_checkpoint(path, tensors, description)


def describe(path: Path) -> dict[str, Any]:
    """Reads what a checkpoint says of itself.

    Args:
        path: of the file.

    Returns:
        ``done`` updates, ``config``, ``network``, ``scenes``, ``origin`` and ``pool``.

    Raises:
        InputError: the file is no checkpoint.
    """
    description = read_description(path, _READ_REMEDY)
    try:
        # Older checkpoints lack settings that have since been added; they mean the defaults.
        description["network"] = NetworkConfig(**description["network"]).model_dump(mode="json")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the checkpoint cannot be read: {error}", remedy=_READ_REMEDY, file=path) from error
    return description


def resume(training: MetaTraining, path: Path, origin: Mapping[str, str] | None = None) -> None:
    """Takes a new training to where a checkpoint was saved.

    Args:
        training: made with the same network, scenes and configuration; changed in place.
        path: of the checkpoint.
        origin: as for :func:`save`.

    Raises:
        InputError: the checkpoint was saved with others, is damaged, or is none.
    """
    description = describe(path)
    # Before anything is changed: a refused checkpoint leaves the new training as it was.
    _check_settings(training, description, path, origin or {})
    tensors = _read_tensors(path, next(training.network.parameters()).device)
    training.network.load_state_dict(_with_prefix(tensors, "weights."))
    _restore_adam(training, _with_prefix(tensors, "optimiser."))
    training.done = description["done"]
    training.pool = []
    for i, entry in enumerate(description["pool"]):
        training.pool.append(_restore_episode(training, entry, _with_prefix(tensors, f"pool.{i}.")))
    # Last, so that nothing above can have drawn from it.
    training.generator.set_state(tensors["generator"])


def load_weights(network: LearnedOptimiser, path: Path) -> None:
    """Gives a network the weights of a checkpoint.

    Args:
        network: of the checkpoint's shape, on the CPU; changed in place.
        path: of the checkpoint.

    Raises:
        InputError: its weights are not those of such a network, or the file is damaged.
    """
    weights = _with_prefix(_read_tensors(path, torch.device("cpu")), "weights.")
    require_weights_fit(weights, network.state_dict(), path, REMEDY)
    network.load_state_dict(weights)


def _describe_settings(training: MetaTraining) -> dict[str, Any]:
    return {
        "scenes": [scene.name for scene in training.scenes],
        "config": training.config.model_dump(mode="json"),
        "network": training.network.config.model_dump(mode="json"),
    }


def _check_settings(
    training: MetaTraining, description: Mapping[str, Any], path: Path, origin: Mapping[str, str]
) -> None:
    settings = _describe_settings(training)
    changed = [name for name, value in settings.items() if description[name] != value]
    changed += [name for name, value in origin.items() if description["origin"].get(name) != value]
    # Going on under other settings would give weights that no configuration describes.
    if changed:
        names = " and ".join(dict.fromkeys(changed))
        raise InputError(f"The checkpoint was made with other {names}", remedy=REMEDY, file=path)


def _read_tensors(path: Path, device: torch.device) -> dict[str, Tensor]:
    _, tensors = read_checkpoint(path, _READ_REMEDY)

    # Adam counts its steps, and generators keep their state, on the CPU.
    def stays(name: str) -> bool:
        return name == "generator" or name.startswith("optimiser.step.")

    return {name: value if stays(name) else value.to(device) for name, value in tensors.items()}


def _adam_tensors(training: MetaTraining) -> list[tuple[str, Tensor]]:
    """Adam's state by parameter name."""
    out = []
    for name, parameter in training.network.named_parameters():
        # By name and not by index, so that a checkpoint does not depend on the order of parameters.
        for key, value in training.optimiser.state.get(parameter, {}).items():
            out.append((f"{key}.{name}", torch.as_tensor(value)))
    return out


def _restore_adam(training: MetaTraining, tensors: Mapping[str, Tensor]) -> None:
    for name, parameter in training.network.named_parameters():
        state = {key: tensors[f"{key}.{name}"] for key in ADAM_NAMES if f"{key}.{name}" in tensors}
        if state:
            training.optimiser.state[parameter] = state


def _describe_episode(episode: Episode) -> dict[str, Any]:
    config = asdict(episode.config)
    # Old checkpoints have the old name, and new ones must stay readable by the same code.
    config[HELD_OUT_VIEWS] = config.pop("held_out_views")
    return {
        "course": config,
        "iteration": episode.state.iteration,
        "loss": None if episode.evaluation is None else episode.evaluation.loss,
        "samplers": [sampler.queues() for sampler in episode.samplers],
    }


def _episode_tensors(episode: Episode) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {name: getattr(episode.state, attribute) for name, attribute in STATE_NAMES.items()}
    if episode.evaluation is not None:
        gradients = episode.evaluation.gradients
        tensors["gradient"] = gradients.gaussians
        if gradients.image_residuals is not None:
            tensors["residuals"] = gradients.image_residuals
    return tensors


def _restore_episode(training: MetaTraining, entry: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Episode:
    settings = dict(entry["course"])
    settings["held_out_views"] = settings.pop(HELD_OUT_VIEWS)
    episode = training.start_episode(EpisodeConfig(**settings))
    gaussians = episode.loop.gaussians
    values = {attribute: tensors[name] for name, attribute in STATE_NAMES.items()}
    gaussians.state = replace(gaussians.state, **values, iteration=entry["iteration"])
    if entry["loss"] is not None:
        gradients = Gradients(tensors["gradient"], image_residuals=tensors.get("residuals"))
        # Counts of culled Gaussians are for reports of stages; training does not read them.
        episode.evaluation = LossAndGradients(entry["loss"], gradients, {})
    for sampler, queues in zip(episode.samplers, entry["samplers"], strict=True):
        sampler.set_queues(queues)
    return episode


def _with_prefix(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin so, without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
