"""Codecs: kind → module with ``write(folder, value)``, ``read(folder, measurements)`` and ``measurements(value)``.

They are imported when they are used: looking up a key should not pay for torch and OpenEXR.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast

from genre_tasks.errors import ConfigError

KINDS: dict[str, str] = {
    "chunk": "storage.codecs.chunk",
    "reconstruction": "storage.codecs.reconstruction",
    "novel_views": "storage.codecs.novel_views",
    "fixed_views": "storage.codecs.fixed_views",
    "pairs": "storage.codecs.pairs",
    "evaluation": "storage.codecs.evaluation",
    "effects": "storage.codecs.effects",
}
"""Kind of artifact → module of its codec. A new kind is one file and one line."""


class Codec(Protocol):
    """Takes a value of the domain to files in a folder and back; the same value gives the same bytes."""

    def write(self, folder: Path, value: Any) -> None:
        """Write the payload into an empty folder. Raises ``ConfigError``, ``NonFiniteError`` for an unfit value."""
        ...

    def read(self, folder: Path, measurements: Mapping[str, Any] | None = None) -> Any:
        """The value; raises ``ArtifactCorruptError`` naming file and column, channel or part."""
        ...

    def measurements(self, value: Any) -> dict[str, Any]:
        """What of the value is a measurement: it goes into the manifest and comes back through :meth:`read`."""
        ...


def codec_of(kind: str) -> Codec:
    """The codec of a kind. Raises ``ConfigError`` that lists the known kinds."""
    if kind not in KINDS:
        near = difflib.get_close_matches(kind, KINDS, 1)
        hint = f"Did you mean {near[0]!r}? " if near else ""
        raise ConfigError(f"There is no artifact kind {kind!r}", remedy=f"{hint}Known kinds: {', '.join(KINDS)}.")
    return cast(Codec, import_module(KINDS[kind]))
