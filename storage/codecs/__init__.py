"""Codecs: kind → module with ``write(folder, value)``, ``read(folder, measurements)`` and ``measurements(value)``.

They are imported when they are used: looking up a key should not pay for torch and OpenEXR.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast

from genre_tasks.errors import ConfigError
from genre_tasks.suggestions import did_you_mean

KINDS: dict[str, str] = {
    "chunk": "storage.codecs.chunk",
    "reconstruction": "storage.codecs.reconstruction",
    "novel_views": "storage.codecs.novel_views",
    "fixed_views": "storage.codecs.fixed_views",
    "pairs": "storage.codecs.pairs",
    "evaluation": "storage.codecs.evaluation",
    "effects": "storage.codecs.effects",
    "rollout_scores": "storage.codecs.rollout_scores",
}
"""Kind of artifact → module of its codec. A new kind is one file and one line."""


class Codec(Protocol):
    """Takes a value of the domain to files in a folder and back; the same value gives the same bytes."""

    def write(self, folder: Path, value: Any) -> None:
        """Writes the payload.

        Args:
            folder: an empty folder.
            value: the value to store.

        Raises:
            ConfigError: a dtype, shape or name breaks the codec's contract.
            NonFiniteError: a number that must be finite is not.
        """
        ...

    def read(self, folder: Path, measurements: Mapping[str, Any] | None = None) -> Any:
        """Reads the payload.

        Args:
            folder: the folder that :meth:`write` filled.
            measurements: what :meth:`measurements` gave, from the manifest.

        Returns:
            The value, with tensors on the CPU.

        Raises:
            ArtifactCorruptError: a file is missing or does not decode; it names the file and the column or channel.
        """
        ...

    def measurements(self, value: Any) -> dict[str, Any]:
        """Selects what of a value is a measurement: it differs between runs, so it belongs in the manifest.

        Args:
            value: the value to store.

        Returns:
            JSON values by name, which come back through :meth:`read`.
        """
        ...


def get_codec(kind: str) -> Codec:
    """Finds the codec of a kind of artifact.

    Args:
        kind: a key of :data:`KINDS`.

    Returns:
        The codec's module.

    Raises:
        ConfigError: the kind is unknown; the known ones are listed.

    >>> get_codec("evaluation").__name__
    'storage.codecs.evaluation'
    """
    if kind not in KINDS:
        hint = did_you_mean(kind, KINDS)
        raise ConfigError(f"There is no artifact kind {kind!r}", remedy=f"{hint}Known kinds: {', '.join(KINDS)}.")
    # A module fits the protocol with its functions, which a type checker cannot see through a name.
    return cast(Codec, import_module(KINDS[kind]))
