"""Fixers to files and back: safetensors with a JSON of the configuration beside them.

``small`` stores the whole network in half precision; ``sd-turbo`` stores adapters and skips, and names its base.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from genre_tasks.errors import InputError
from genre_tasks.fixer.network import Fnet, FnetArchitecture, build, sd_turbo

REMEDY = "Give weights that `genre train fnet` wrote for this version, or leave `fnet.weights` at builtin."


def save_fnet(fnet: Fnet, path: Path, base: str | None = None, rank: int | None = None) -> None:
    """Writes ``path`` (…/fnet.safetensors) and the JSON beside it; each is renamed into place.

    With ``base`` (a folder relative to ``path``'s, or a hub id) only what LoRA training changes is written.
    """
    from safetensors.torch import save_file

    if base is None:
        document: dict[str, Any] = {"model": "small", "architecture": fnet.architecture.as_json()}
        tensors = fnet.state_dict()
    else:
        document = {"model": "sd-turbo", "base": base, "rank": rank, "timestep": fnet.architecture.timestep}
        tensors = trainable_state(fnet)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".tmp")
    save_file({k: v.detach().half().contiguous().cpu() for k, v in sorted(tensors.items())}, part)
    part.replace(path)
    part.write_text(json.dumps(document, indent=2, sort_keys=True) + "\n")
    part.replace(path.with_suffix(".json"))


def load_fnet(path: Path, model: str = "small") -> Fnet:
    """The fixer of a file, or of a folder that holds ``fnet.safetensors`` and ``fnet.json``; ready for inference.

    Raises:
        InputError: a file is missing or unreadable, is of the other model, or keys, shapes or dtypes do not fit.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    path = path / "fnet.safetensors" if path.is_dir() else path
    document = _read_document(path.with_suffix(".json"))
    if document.get("model") != model:
        raise InputError(
            f"the weights are of the model {document.get('model')!r}, the configuration says {model!r}",
            remedy="Set `fnet.model` to the weights' model, or give other weights.",
            file=path,
            stage="fnet",
        )
    try:
        tensors = load_file(path)
    except (OSError, SafetensorError) as error:
        raise InputError(f"the weights cannot be read: {error}", remedy=REMEDY, file=path, stage="fnet") from error
    fnet = _network(document, path)
    _check(tensors, fnet.state_dict() if model == "small" else trainable_state(fnet), path)
    fnet.load_state_dict({k: v.float() for k, v in tensors.items()}, strict=False)
    return fnet.eval().requires_grad_(False)


def trainable_state(fnet: Fnet) -> dict[str, Tensor]:
    """The parameters that training changes, by name."""
    return {name: p for name, p in fnet.named_parameters() if p.requires_grad}


def _network(document: dict[str, Any], path: Path) -> Fnet:
    try:
        if document["model"] == "small":
            return build(FnetArchitecture(**document["architecture"]))
        local = path.parent / document["base"]
        source = str(local) if local.exists() else document["base"]
        return sd_turbo(source, document["timestep"], document["rank"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"the configuration of the weights does not describe a fixer: {error}",
            remedy=REMEDY,
            file=path.with_suffix(".json"),
            stage="fnet",
        ) from error


def _read_document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(
            f"the configuration of the weights cannot be read: {error}", remedy=REMEDY, file=path, stage="fnet"
        ) from error
    if not isinstance(document, dict):
        raise InputError("the configuration of the weights is no object", remedy=REMEDY, file=path, stage="fnet")
    return document


def _check(found: Mapping[str, Tensor], expected: Mapping[str, Tensor], path: Path) -> None:
    """Raises one ``InputError`` that names missing and extra keys, other shapes, other dtypes and non-finite values."""
    problems = [f"missing key {k}" for k in sorted(expected.keys() - found.keys())]
    problems += [f"extra key {k}" for k in sorted(found.keys() - expected.keys())]
    for key in sorted(found.keys() & expected.keys()):
        tensor, want = found[key], expected[key]
        if tensor.shape != want.shape:
            problems.append(f"{key} has shape {list(tensor.shape)}, expected {list(want.shape)}")
        elif tensor.dtype not in (torch.float16, torch.bfloat16, torch.float32):
            problems.append(f"{key} has dtype {tensor.dtype}, expected float16, bfloat16 or float32")
        elif not bool(torch.isfinite(tensor).all()):
            problems.append(f"{key} holds non-finite values")
    if problems:
        more = f" and {len(problems) - 5} more" if len(problems) > 5 else ""
        raise InputError(
            f"the weights do not fit the network: {'; '.join(problems[:5])}{more}",
            remedy=REMEDY,
            file=path,
            stage="fnet",
        )
