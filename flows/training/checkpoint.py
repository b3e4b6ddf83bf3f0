"""Checkpoints of meta-training that resume to the same bytes: weights, optimiser, pool, generator, samplers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from genre_tasks.errors import InputError
from genre_tasks.learned.meta_episodes import Course, Episode
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.optimiser.objective import Sight
from genre_tasks.learned.meta_training import MetaTraining
from genre_tasks.learned.weights import write_atomically

STATE = ("offsets", "first", "second", "seen", "seen_now")


REMEDY = "Train with the same settings, or into an empty folder."


def save(training: MetaTraining, path: Path, origin: Mapping[str, str] | None = None) -> None:
    """One file, complete or not at all. ``origin``: what else the training depends on, name → digest."""
    from safetensors.torch import save as serialise

    tensors = {f"weights.{k}": v for k, v in training.network.state_dict().items()}
    for name, value in _moments(training):
        tensors[f"optimiser.{name}"] = value
    tensors["generator"] = training.generator.get_state()
    for i, episode in enumerate(training.pool):
        tensors |= {f"pool.{i}.{name}": getattr(episode.state, name) for name in STATE}
        if episode.sight is not None:
            tensors[f"pool.{i}.gradient"] = episode.sight.gradient
            if episode.sight.residuals is not None:
                tensors[f"pool.{i}.residuals"] = episode.sight.residuals
    described = {
        "done": training.done,
        "scenes": [s.name for s in training.scenes],
        "config": training.config.model_dump(mode="json"),
        "network": training.network.config.model_dump(mode="json"),
        "origin": dict(origin or {}),
        "pool": [_described(e) for e in training.pool],
    }
    own = {k: v.detach().clone().contiguous() for k, v in tensors.items()}
    write_atomically(path, serialise(own, {"training": json.dumps(described)}))


def describe(path: Path) -> dict[str, Any]:
    """What the checkpoint says of itself: ``done`` updates, ``config``, ``network``, ``scenes``, ``origin``, ``pool``.

    Raises ``InputError`` where it is no checkpoint.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            described: dict[str, Any] = json.loads((file.metadata() or {})["training"])
        described["network"] = NetworkConfig(**described["network"]).model_dump(mode="json")  # older ones say less
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise InputError(
            f"The checkpoint cannot be read: {error}", remedy="Delete it to train the stage anew.", file=path
        ) from error
    return described


def resume(training: MetaTraining, path: Path, origin: Mapping[str, str] | None = None) -> None:
    """Takes ``training``, made anew with the same network, scenes and configuration, to where ``path`` was saved.

    Raises ``InputError`` where it was saved with others, or is no checkpoint.
    """
    from safetensors import safe_open

    described = describe(path)
    now = {
        "scenes": [s.name for s in training.scenes],
        "config": training.config.model_dump(mode="json"),
        "network": training.network.config.model_dump(mode="json"),
    }
    changed = [name for name, value in now.items() if described[name] != value]
    changed += [name for name, value in (origin or {}).items() if described["origin"].get(name) != value]
    if changed:
        raise InputError(
            f"The checkpoint was made with other {' and '.join(dict.fromkeys(changed))}", remedy=REMEDY, file=path
        )
    device = next(training.network.parameters()).device
    with safe_open(path, "pt") as file:
        tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 - not a dictionary
    # Adam counts its steps, and generators keep their state, on the CPU.
    tensors = {
        k: v if k == "generator" or k.startswith("optimiser.step.") else v.to(device) for k, v in tensors.items()
    }
    training.network.load_state_dict({k.removeprefix("weights."): v for k, v in _under(tensors, "weights.")})
    _restore_moments(training, dict(_under(tensors, "optimiser.")))
    training.done = described["done"]
    training.pool = []
    for i, entry in enumerate(described["pool"]):
        training.pool.append(_episode(training, entry, dict(_under(tensors, f"pool.{i}."))))
    training.generator.set_state(tensors["generator"])


def _moments(training: MetaTraining) -> list[tuple[str, Tensor]]:
    """Adam's state by parameter name."""
    out = []
    for name, parameter in training.network.named_parameters():
        for key, value in training.optimiser.state.get(parameter, {}).items():
            out.append((f"{key}.{name}", torch.as_tensor(value)))
    return out


def _restore_moments(training: MetaTraining, tensors: dict[str, Tensor]) -> None:
    for name, parameter in training.network.named_parameters():
        state = {
            key: tensors[f"{key}.{name}"] for key in ("step", "exp_avg", "exp_avg_sq") if f"{key}.{name}" in tensors
        }
        if state:
            training.optimiser.state[parameter] = state


def _described(episode: Episode) -> dict[str, Any]:
    return {
        "course": asdict(episode.course),
        "iteration": episode.state.iteration,
        "loss": None if episode.sight is None else episode.sight.loss,
        "samplers": [s.queues() for s in episode.samplers],
    }


def _episode(training: MetaTraining, entry: dict[str, Any], tensors: dict[str, Tensor]) -> Episode:
    course = Course(**entry["course"])
    episode = Episode.start(course, training.scenes[course.scene], training.network, training.generator)
    episode.state = replace(episode.state, **{name: tensors[name] for name in STATE}, iteration=entry["iteration"])
    if entry["loss"] is not None:
        episode.sight = Sight(entry["loss"], tensors["gradient"], {}, residuals=tensors.get("residuals"))
    for sampler, queues in zip(episode.samplers, entry["samplers"], strict=True):
        sampler.set_queues(queues)
    return episode


def _under(tensors: dict[str, Tensor], prefix: str) -> list[tuple[str, Tensor]]:
    return [(k.removeprefix(prefix), v) for k, v in tensors.items() if k.startswith(prefix)]
