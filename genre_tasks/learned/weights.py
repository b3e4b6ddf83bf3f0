"""The learned optimiser's weights on disk: safetensors with a JSON configuration beside them."""

from __future__ import annotations

from pathlib import Path

import torch
from pydantic import ValidationError

from genre_tasks.atomic_path import write_atomically
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.json_files import read_json_object
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.learned.weight_files import REMEDY
from genre_tasks.optimiser.kernels.constants import IMAGE_RESIDUALS, VARYING_FEATURES
from genre_tasks.weight_checks import require_weights_fit


def load_optimiser(weights: Path) -> LearnedOptimiser:
    """Reads a learned optimiser from its weights and the configuration beside them.

    Args:
        weights: a file ``X.safetensors``, with ``X.json`` in the same folder.

    Returns:
        The network in float32 on the CPU, without gradients.

    Raises:
        InputError: a file is missing or unreadable; or tensors are missing, unknown, or of another shape or dtype,
            and the error names them.
        ConfigError: the configuration does not describe a network.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    config_file = weights.with_suffix(".json")
    for path in (weights, config_file):
        if not path.is_file():
            raise InputError("The optimiser's weights are missing", remedy=REMEDY, file=path)
    values = read_json_object(config_file, "network's configuration", REMEDY, kind=ConfigError)
    try:
        config = NetworkConfig.model_validate(values)
    except ValidationError as error:
        # pydantic's message goes on with links; its first lines name the keys.
        detail = "; ".join(str(error).splitlines()[:4])
        raise ConfigError(
            f"The network's configuration is not valid: {detail}", remedy=REMEDY, file=config_file
        ) from None
    try:
        # Pickled weights could run code; safetensors cannot.
        tensors = load_file(weights, device="cpu")
    except (SafetensorError, OSError) as error:
        raise InputError(f"The weights cannot be read: {error}", remedy=REMEDY, file=weights) from error
    # Random weights are replaced at once, and must not change what others draw from the global generator.
    with torch.random.fork_rng(devices=[]):
        # Without memory at first: the configuration may describe a network that is larger than the file.
        with torch.device("meta"):
            expected = LearnedOptimiser(config).state_dict()
        # Compared by hand, since torch's strict loading casts other dtypes without a word.
        require_weights_fit(tensors, expected, weights, REMEDY)
        network = LearnedOptimiser(config)
    network.load_state_dict(tensors)
    return network.eval().requires_grad_(False)


def save_optimiser(network: LearnedOptimiser, weights: Path) -> None:
    """Writes a learned optimiser; each file is complete or absent at any moment.

    Args:
        network: the network to write.
        weights: the file ``X.safetensors``; the configuration goes to ``X.json``.
    """
    from safetensors.torch import save

    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    # The configuration first: weights without one are not readable.
    write_atomically(weights.with_suffix(".json"), (network.config.model_dump_json(indent=2) + "\n").encode())
    write_atomically(weights, save(tensors))


def add_residual_inputs(network: LearnedOptimiser) -> dict[str, torch.Tensor]:
    """Extends weights for a network that uses image residuals, which then makes the same steps at first.

    Args:
        network: weights of a network with or without residuals.

    Returns:
        The state of a network with residuals; what the residuals feed is zero where ``network`` lacks it.
    """
    weights = dict(network.state_dict())
    if network.uses_image_residuals:
        return weights
    entry = weights["entry.weight"]
    head = weights["head.weight"]
    bias = weights["head.bias"]
    residual_columns = entry.new_zeros((len(entry), IMAGE_RESIDUALS))
    # Residuals stand between the features that vary and those of the schedule, see ``features.compute_features``.
    weights["entry.weight"] = torch.cat([entry[:, :VARYING_FEATURES], residual_columns, entry[:, VARYING_FEATURES:]], 1)
    weights["head.weight"] = torch.cat([head, head.new_zeros((1, head.shape[1]))])
    weights["head.bias"] = torch.cat([bias, bias.new_zeros(1)])
    return weights
