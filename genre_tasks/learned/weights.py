"""Weights as safetensors with a JSON configuration beside them."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from pydantic import ValidationError

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.optimiser.kernels.constants import RESIDUALS, VARYING

REMEDY = "Give weights made by `genre train gnet` or `genre train enet`, or use `builtin`."


def load(weights: Path) -> LearnedOptimiser:
    """The network of ``weights`` (``X.safetensors`` with ``X.json`` beside it), float32, on the CPU.

    Raises ``InputError`` for a missing or unreadable file and for tensors that are missing, too many, or of another
    shape or dtype, naming them; ``ConfigError`` for a configuration that does not describe a network.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    described = weights.with_suffix(".json")
    for path in (weights, described):
        if not path.is_file():
            raise InputError("The optimiser's weights are missing", remedy=REMEDY, file=path)
    try:
        config = NetworkConfig.model_validate_json(described.read_text())
    except (ValidationError, ValueError) as error:
        detail = "; ".join(str(error).splitlines()[:4])
        raise ConfigError(
            f"The network's configuration is not valid: {detail}", remedy=REMEDY, file=described
        ) from None
    try:
        tensors = load_file(weights, device="cpu")
    except (SafetensorError, OSError) as error:
        raise InputError(f"The weights cannot be read: {error}", remedy=REMEDY, file=weights) from error
    network = LearnedOptimiser(config)
    problems = _differences(network.state_dict(), tensors)
    if problems:
        raise InputError(f"The weights do not fit the network: {problems}", remedy=REMEDY, file=weights)
    network.load_state_dict(tensors)
    return network.eval().requires_grad_(False)


def save(network: LearnedOptimiser, weights: Path) -> None:
    """Writes ``X.safetensors`` and ``X.json``, each complete or not at all."""
    from safetensors.torch import save as serialise

    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    write_atomically(weights.with_suffix(".json"), (network.config.model_dump_json(indent=2) + "\n").encode())
    write_atomically(weights, serialise(tensors))


def with_residuals(network: LearnedOptimiser) -> dict[str, torch.Tensor]:
    """The weights of a network that is told residuals: those of ``network``, and zeros for what these bring."""
    weights = dict(network.state_dict())
    if network.residuals:
        return weights
    entry, weight, bias = weights["entry.weight"], weights["head.weight"], weights["head.bias"]
    told = entry.new_zeros((len(entry), RESIDUALS))
    weights["entry.weight"] = torch.cat([entry[:, :VARYING], told, entry[:, VARYING:]], 1)
    weights["head.weight"] = torch.cat([weight, weight.new_zeros((1, weight.shape[1]))])
    weights["head.bias"] = torch.cat([bias, bias.new_zeros(1)])
    return weights


def write_atomically(path: Path, data: bytes) -> None:
    """Under a temporary name in the same folder, synced, then renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    with temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def _differences(wanted: dict[str, torch.Tensor], found: dict[str, torch.Tensor]) -> str:
    """What does not fit, in words; empty where everything does."""
    parts = []
    if missing := sorted(wanted.keys() - found.keys()):
        parts.append(f"missing {', '.join(missing)}")
    if extra := sorted(found.keys() - wanted.keys()):
        parts.append(f"unknown {', '.join(extra)}")
    for name in sorted(wanted.keys() & found.keys()):
        a, b = wanted[name], found[name]
        if a.shape != b.shape or a.dtype != b.dtype:
            kinds = [f"{str(x.dtype).removeprefix('torch.')} {list(x.shape)}" for x in (a, b)]
            parts.append(f"{name} is {kinds[1]} where {kinds[0]} is expected")
    return "; ".join(parts)
