"""Weights that ship with the package, and the one place where a configured name becomes a path."""

from __future__ import annotations

from pathlib import Path

from genre_tasks.errors import InputError


def network_of(stage: str, method: str) -> str:
    """Whose weights a stage runs with: its own network's, or those of the method that stands in its place."""
    return "g3r" if method == "g3r" else stage


def resolve_weights(name: str, configured: str, setting: str = "") -> Path:
    """The file (or folder) that ``configured`` names.

    Args:
        name: the network, as ``fnet``, ``gnet``, ``g3r`` or ``enet``: the stem of its built-in file.
        configured: ``builtin``, ``builtin:gnet`` for those that ship for another network, or a path.
        setting: the key that said so, for messages; ``NAME.weights`` if not given.

    Raises:
        InputError: it does not exist.
    """
    setting, (first, colon, other) = setting or f"{name}.weights", configured.partition(":")
    if first == "builtin":
        path = Path(__file__).parent / f"{other if colon else name}.safetensors"
        known = ", ".join(sorted(p.stem for p in path.parent.glob("*.safetensors")))
        remedy = f"Those of {known} ship; train weights with `genre train {name}`, or give a path by `{setting}`."
    else:
        path = Path(configured).expanduser()
        remedy = f"Check `{setting}`, or leave it at `builtin`."
    if not path.exists():
        raise InputError(f"the weights of {name} do not exist", remedy=remedy, file=path, stage=name)
    return path
