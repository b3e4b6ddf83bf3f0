"""The files of a learned optimiser's weights, and what can be checked of them without torch."""

from __future__ import annotations

from pathlib import Path

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.json_files import read_json_object
from genre_tasks.weight_files import read_tensor_shapes

REMEDY = "Give weights made by `genre train gnet` or `genre train enet`, or use `builtin`."


def check_optimiser_files(weights: Path) -> None:
    """Checks that weights are there, complete and those of a learned optimiser, as far as their headers tell.

    Args:
        weights: a file ``X.safetensors``, with ``X.json`` in the same folder.

    Raises:
        InputError: a file is missing or unreadable, or the weights are of another network.
        ConfigError: the configuration beside them is no JSON object.
    """
    config_file = weights.with_suffix(".json")
    for path in (weights, config_file):
        if not path.is_file():
            raise InputError("The optimiser's weights are missing", remedy=REMEDY, file=path)
    config = read_json_object(config_file, "network's configuration", REMEDY, kind=ConfigError)
    shapes = read_tensor_shapes(weights, REMEDY)
    head = shapes.get("head.weight")
    if head is None:
        raise InputError(
            "the weights are of no learned optimiser: they have no head.weight", remedy=REMEDY, file=weights
        )
    # The head's input is the width, and its first layer's output; the other layers follow from them.
    if head[1:] != (config.get("hidden"),):
        raise InputError(
            f"the weights do not fit their configuration: head.weight is {list(head)}, "
            f"and {config_file.name} has a width of {config.get('hidden')!r}",
            remedy=REMEDY,
            file=weights,
        )
