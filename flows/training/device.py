"""Where a training runs: networks, Gaussians and targets on one device; views and files are chosen on the CPU."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from genre_tasks.errors import ConfigError
from genre_tasks.learned.meta_episodes import TrainingScene


def chosen_device(name: str) -> torch.device:
    """``auto``: a GPU where there is one and gsplat to render on it, else the CPU.

    Raises ``ConfigError`` for an unknown name, and for ``cuda`` without either.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"no device is called {name!r}", remedy="Give auto, cpu or cuda.")
    lacks = [what for what, there in _PRESENT.items() if not there()]
    if name == "cuda" and lacks:
        raise ConfigError(f"cuda needs {' and '.join(lacks)}", remedy="Give --device cpu; `genre doctor` says more.")
    return torch.device("cpu" if lacks or name == "cpu" else "cuda")


_PRESENT = {"a GPU": torch.cuda.is_available, "gsplat": lambda: find_spec("gsplat") is not None}


def scene_on(scene: TrainingScene, device: torch.device) -> TrainingScene:
    """The scene with all its tensors on ``device``; the same one where they are there."""
    moved: TrainingScene = _on(scene, device)
    return moved


def _on(value: Any, device: torch.device) -> Any:
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, tuple):
        return tuple(_on(item, device) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: _on(getattr(value, f.name), device) for f in fields(value)})
    return value
