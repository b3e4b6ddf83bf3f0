"""Reads and writes fixers: safetensors with a JSON of the configuration next to them.

``small`` stores the whole network in half precision; ``sd-turbo`` stores adapters and skips, and names its base.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from genre_tasks.atomic_path import write_atomically
from genre_tasks.errors import InputError
from genre_tasks.fixer.architectures import build_fnet, load_sd_turbo
from genre_tasks.fixer.network import Fnet, FnetArchitecture
from genre_tasks.fixer.weight_files import REMEDY, read_fixer_document
from genre_tasks.weight_checks import require_weights_fit
from genre_tasks.weights import find_tensors_file

# A network also has a few numbers that no file holds.
_MAX_SIZE_RATIO = 2
_MAX_LAYERS = 16
# What diffusers raises where an architecture's numbers do not go together.
_CONSTRUCTION_ERRORS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    RuntimeError,
    TypeError,
    ValueError,
)
# Files are in half precision; weights of other tools are in any of these, and all are used in float32.
_FILE_DTYPES = (torch.float16, torch.bfloat16, torch.float32)


def save_fnet(fnet: Fnet, path: Path, base: str | None = None, rank: int | None = None) -> None:
    """Writes a fixer and the JSON next to it; each file is complete or not there.

    Args:
        fnet: the network.
        path: of the weights, …/fnet.safetensors; its folder is made where it is missing.
        base: SD-Turbo's folder, absolute or relative to that of ``path``, or a hub id. With it only what LoRA
            training changes is written.
        rank: of the adapters, with ``base``.
    """
    from safetensors.torch import save

    if base is None:
        document: dict[str, Any] = {"model": "small", "architecture": fnet.architecture.as_json()}
        tensors = fnet.state_dict()
    else:
        document = {"model": "sd-turbo", "base": base, "rank": rank, "timestep": fnet.architecture.timestep}
        tensors = trainable_state(fnet)
    # Half precision halves the file; loading widens the weights again.
    halves = {name: value.detach().half().contiguous().cpu() for name, value in sorted(tensors.items())}
    # The configuration first: at no moment are there weights that nothing describes.
    write_atomically(path.with_suffix(".json"), (json.dumps(document, indent=2, sort_keys=True) + "\n").encode())
    write_atomically(path, save(halves))


def load_fnet(path: Path, model: str = "small") -> Fnet:
    """Loads a fixer for inference.

    Args:
        path: of the weights, or a folder that holds ``fnet.safetensors`` and ``fnet.json``.
        model: ``small`` or ``sd-turbo``, which the weights must be of.

    Returns:
        The network, frozen.

    Raises:
        InputError: a file is missing or unreadable, is of the other model, or keys, shapes or dtypes do not fit.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    path = find_tensors_file(path)
    # Checked before the tensors are read, which takes long for the larger model.
    document = read_fixer_document(path, model)
    try:
        tensors = load_file(path)
    except (OSError, SafetensorError) as error:
        raise InputError(f"the weights cannot be read: {error}", remedy=REMEDY, file=path, stage="fnet") from error
    if model == "small":
        _require_plausible_size(document, sum(value.numel() for value in tensors.values()), path)
    fnet = _build_described(document, path)
    # Checked before loading, because torch's own error names neither the file nor a remedy.
    expected = fnet.state_dict() if model == "small" else trainable_state(fnet)
    require_weights_fit(tensors, expected, path, REMEDY, stage="fnet", dtypes=_FILE_DTYPES)
    fnet.load_state_dict({name: value.float() for name, value in tensors.items()}, strict=False)
    return fnet.eval().requires_grad_(False)


def trainable_state(fnet: Fnet) -> dict[str, Tensor]:
    """Collects the parameters that training changes.

    Args:
        fnet: the network.

    Returns:
        Parameters by name.
    """
    return {name: parameter for name, parameter in fnet.named_parameters() if parameter.requires_grad}


def _build_described(document: dict[str, Any], path: Path) -> Fnet:
    """Builds the network that the JSON describes, without the weights."""
    try:
        if document["model"] == "small":
            return build_fnet(FnetArchitecture(**document["architecture"]))
        # A base next to the weights moves with them; anything else is a hub id.
        local = path.parent / document["base"]
        source = str(local) if local.exists() else document["base"]
        return load_sd_turbo(source, document["timestep"], document["rank"])
    except _CONSTRUCTION_ERRORS as error:
        raise _describe_no_fixer(error, path) from error


def _require_plausible_size(document: dict[str, Any], weight_count: int, path: Path) -> None:
    """Refuses a description of a network that is much larger than the file, before memory is taken for it."""
    from diffusers import AutoencoderKL, UNet2DConditionModel

    try:
        architecture = FnetArchitecture(**document["architecture"])
        _check_depth(architecture.vae)
        _check_depth(architecture.unet)
        with torch.device("meta"):
            networks: tuple[Any, ...] = (AutoencoderKL(**architecture.vae), UNet2DConditionModel(**architecture.unet))
    except _CONSTRUCTION_ERRORS as error:
        raise _describe_no_fixer(error, path) from error
    described = sum(parameter.numel() for network in networks for parameter in network.parameters())
    if described > _MAX_SIZE_RATIO * weight_count:
        raise _describe_no_fixer(f"it has {described} weights, and the file {weight_count}", path)


def _check_depth(arguments: dict[str, Any]) -> None:
    """Raises ``ValueError`` for a network of so many layers that building it would take for ever."""
    for name, value in arguments.items():
        counts = value if isinstance(value, list) else [value]
        has_many = "layers" in name and any(isinstance(count, int) and count > _MAX_LAYERS for count in counts)
        if has_many or len(counts) > _MAX_LAYERS:
            raise ValueError(f"{name} has more than {_MAX_LAYERS} layers or levels")


def _describe_no_fixer(reason: object, path: Path) -> InputError:
    return InputError(
        f"the configuration of the weights does not describe a fixer: {reason}",
        remedy=REMEDY,
        file=path.with_suffix(".json"),
        stage="fnet",
    )
