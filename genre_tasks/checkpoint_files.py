"""Files of checkpoints: tensors and what describes them in one safetensors file, with a digest of both.

Safetensors checks where a tensor lies and how long it is, but not its bytes: a training that went on from altered ones
would end in other weights without a word.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from genre_tasks.atomic_path import write_atomically
from genre_tasks.errors import InputError

_DESCRIPTION = "training"
_DIGEST = "digest"


def write_checkpoint(path: Path, tensors: Mapping[str, Tensor], description: Mapping[str, Any]) -> None:
    """Writes a checkpoint as one file, complete or not at all.

    Args:
        path: of the file; its folder is made where it is missing.
        tensors: by name, on any device.
        description: of the tensors, as JSON has it.
    """
    from safetensors.torch import save

    # Clones, because safetensors refuses tensors that share memory, as the moments of a new state do.
    copies = {name: value.detach().cpu().clone().contiguous() for name, value in tensors.items()}
    # Within the description: safetensors writes several entries in an order that differs from time to time.
    text = json.dumps(dict(description) | {_DIGEST: _digest(copies, json.dumps(description))})
    write_atomically(path, save(copies, {_DESCRIPTION: text}))


def read_description(path: Path, remedy: str, stage: str | None = None) -> dict[str, Any]:
    """Reads what a checkpoint says of itself, without its tensors.

    Args:
        path: of the file.
        remedy: what to do about a file that cannot be read.
        stage: that is trained, for the error.

    Returns:
        The description, as :func:`write_checkpoint` got it.

    Raises:
        InputError: the file is no checkpoint.
    """
    return _parse(_read(path, remedy, stage)[0], path, remedy, stage)[0]


def read_checkpoint(path: Path, remedy: str, stage: str | None = None) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Reads a checkpoint.

    Args:
        path: of the file.
        remedy: what to do about a file that cannot be read.
        stage: that is trained, for the error.

    Returns:
        The description, and the tensors on the CPU.

    Raises:
        InputError: the file is no checkpoint, or its bytes are not those that were written.
    """
    metadata, tensors = _read(path, remedy, stage, with_tensors=True)
    description, digest = _parse(metadata, path, remedy, stage)
    # Older checkpoints have no digest.
    if digest is not None and digest != _digest(tensors, json.dumps(description)):
        problem = "the checkpoint's bytes have changed since it was written"
        raise InputError(problem, remedy=remedy, file=path, stage=stage)
    return description, tensors


def _read(
    path: Path, remedy: str, stage: str | None, with_tensors: bool = False
) -> tuple[dict[str, str], dict[str, Tensor]]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            names = list(file.keys()) if with_tensors else []
            return dict(file.metadata() or {}), {name: file.get_tensor(name) for name in names}
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"the checkpoint cannot be read: {error}", remedy=remedy, file=path, stage=stage) from error


def _parse(
    metadata: Mapping[str, str], path: Path, remedy: str, stage: str | None
) -> tuple[dict[str, Any], str | None]:
    """Gives the description, and the digest that was written with it."""
    try:
        description = json.loads(metadata[_DESCRIPTION])
    except (KeyError, ValueError, RecursionError) as error:
        raise InputError(f"the checkpoint cannot be read: {error}", remedy=remedy, file=path, stage=stage) from error
    if not isinstance(description, dict):
        problem = "the checkpoint cannot be read: its description is no object"
        raise InputError(problem, remedy=remedy, file=path, stage=stage)
    digest = description.pop(_DIGEST, None)
    return description, digest


def _digest(tensors: Mapping[str, Tensor], description: str) -> str:
    digest = hashlib.sha256(description.encode())
    for name in sorted(tensors):
        value = tensors[name]
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()
