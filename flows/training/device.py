"""Where a training runs: networks, Gaussians and targets on one device; views and files are chosen on the CPU."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from genre_tasks.errors import ConfigError
from genre_tasks.learned.meta_episodes import TrainingScene


def choose_device(name: str, with_effects: bool = False) -> torch.device:
    """Chooses the device to train on.

    Args:
        name: ``cpu``, ``cuda``, or ``auto`` for a GPU where there is one and gsplat to render on it, else the CPU.
        with_effects: scenes are as their plans of effects have them; ``auto`` then means the CPU.

    Returns:
        The device.

    Raises:
        ConfigError: the name is unknown, ``cuda`` lacks a GPU or gsplat, or cannot render the scenes.

    >>> choose_device("cpu"), choose_device("auto", with_effects=True)
    (device(type='cpu'), device(type='cpu'))
    """
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"no device is called {name!r}", remedy="Give auto, cpu or cuda.")
    # gsplat moves no Gaussians during a readout, and streets have cars and a rolling shutter.
    if name == "cuda" and with_effects:
        raise ConfigError("cuda cannot render scenes with effects", remedy="Give --device cpu.")
    # Both are needed: the CPU's kernel cannot render tensors that are on a GPU.
    lacking = [what for what, is_present in _REQUIREMENTS.items() if not is_present()]
    if name == "cuda" and lacking:
        raise ConfigError(f"cuda needs {' and '.join(lacking)}", remedy="Give --device cpu; `genre doctor` says more.")
    return torch.device("cpu" if lacking or with_effects or name == "cpu" else "cuda")


_REQUIREMENTS = {"a GPU": torch.cuda.is_available, "gsplat": lambda: find_spec("gsplat") is not None}


def move_scene(scene: TrainingScene, device: torch.device) -> TrainingScene:
    """Moves all tensors of a scene to a device.

    Args:
        scene: the scene with its targets.
        device: where they are needed.

    Returns:
        The scene there; tensors that are there already are not copied.
    """
    moved: TrainingScene = _move(scene, device)
    return moved


def _move(value: Any, device: torch.device) -> Any:
    # By structure and not by field, so that a new tensor of any target is never left behind.
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, tuple):
        return tuple(_move(item, device) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: _move(getattr(value, f.name), device) for f in fields(value)})
    return value
