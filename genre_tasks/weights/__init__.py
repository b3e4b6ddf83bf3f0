"""Weights that ship with the package, and the one place where a configured name becomes a path."""

from __future__ import annotations

import json
from pathlib import Path

from genre_tasks.errors import InputError
from genre_tasks.user_paths import expand_user_path


def select_network(stage: str, method: str) -> str:
    """Names the network whose weights a stage runs with.

    Args:
        stage: the stage's own network, as ``gnet`` or ``enet``.
        method: the method that runs in the stage.

    Returns:
        The stem of the network's built-in file.

    >>> select_network("gnet", "learned"), select_network("gnet", "g3r")
    ('gnet', 'g3r')
    """
    # g3r runs in gnet's place, with weights that were trained without novel views.
    return "g3r" if method == "g3r" else stage


def resolve_weights(name: str, configured: str, setting: str = "") -> Path:
    """Finds the file or folder that a configured name means.

    Args:
        name: the network, as ``fnet``, ``gnet``, ``g3r`` or ``enet``: the stem of its built-in file.
        configured: ``builtin``, ``builtin:gnet`` for those that ship for another network, or a path.
        setting: the configuration key that holds the name, for messages; ``NAME.weights`` if not given.

    Returns:
        A path that exists.

    Raises:
        InputError: it does not exist; the error lists the networks that ship.

    >>> resolve_weights("gnet", "builtin").name, resolve_weights("gnet", "builtin:enet").name
    ('gnet.safetensors', 'enet.safetensors')
    """
    key = setting or f"{name}.weights"
    # ``builtin:`` with another network's name lets a stage run with weights that were trained for a different one.
    kind, colon, other = configured.partition(":")
    if kind == "builtin":
        # An unknown name is a file that does not exist: the error below lists those that do.
        path = Path(__file__).parent / f"{other if colon else name}.safetensors"
        known = ", ".join(sorted(p.stem for p in path.parent.glob("*.safetensors")))
        remedy = f"Those of {known} ship; train weights with `genre train {name}`, or give a path by `{key}`."
    else:
        path = expand_user_path(configured)
        remedy = f"Check `{key}`, or leave it at `builtin`."
    if not path.exists():
        raise InputError(f"the weights of {name} do not exist", remedy=remedy, file=path, stage=name)
    return path


def find_tensors_file(path: Path) -> Path:
    """Finds the file with the tensors; its configuration is the JSON file of the same name.

    Args:
        path: the file, or a folder with the weights of a fixer.

    Returns:
        The path of a ``.safetensors`` file, which need not exist.
    """
    return path / "fnet.safetensors" if path.is_dir() else path


def list_weights_files(path: Path) -> dict[str, Path]:
    """Lists the files that are read when weights are loaded, and no other files that lie beside them.

    Args:
        path: the file of the tensors, or a folder with the weights of a fixer.

    Returns:
        What the file is for → the file, of those that exist: the tensors, their configuration, and the parts of the
        model that a fixer's weights are based on, where it is in a folder of this machine.
    """
    tensors = find_tensors_file(path)
    configuration = tensors.with_suffix(".json")
    files = {"tensors": tensors, "configuration": configuration}
    base = _find_base(configuration)
    if base is not None:
        for part in (base / "vae", base / "unet"):
            # The names that diffusers looks for; it takes the first format that it finds, so names count too.
            read = [part / "config.json", *part.glob("diffusion_pytorch_model*")]
            files |= {f"{part.name}/{file.name}": file for file in sorted(read)}
    return {use: file for use, file in files.items() if file.is_file()}


def _find_base(configuration: Path) -> Path | None:
    try:
        base = configuration.parent / json.loads(configuration.read_bytes())["base"]
    # Weights without a base have no such key; what cannot be read is an error when they are loaded.
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return base if base.is_dir() else None
