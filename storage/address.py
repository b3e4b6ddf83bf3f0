"""Where an artifact lies: ``<dataset>/<log>/<chunk>/<stage>/<key>/``, a layout a person can walk."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

from genre_tasks.errors import ConfigError

_PART = re.compile(r"[^\x00-\x1f\x7f/\\]{1,200}")


@dataclass(frozen=True, order=True)
class Address:
    """Coordinates of an artifact. ``stage`` may hold "/" (``evaluate/gnet``), which makes folders of it.

    Raises ``ConfigError`` where a part cannot be a folder's name (empty, hidden, ``..``, with a slash or a control
    character), so that no address leads out of the store.
    """

    dataset: str
    log: str
    chunk: int
    stage: str
    key: str

    def __post_init__(self) -> None:
        for name, part in (("dataset", self.dataset), ("log", self.log), ("key", self.key)):
            self._check(name, part)
        for part in self.stage.split("/"):
            self._check("stage", part)
        if self.chunk < 0:
            raise ConfigError(f"Chunk {self.chunk} is negative", remedy="Chunks count from 0.", log=self.log)

    def _check(self, name: str, part: str) -> None:
        if not _PART.fullmatch(part) or part.startswith("."):
            raise ConfigError(
                f"The {name} {part!r} cannot be a folder's name",
                remedy="Use letters, digits, and any of - _ = + . inside; not empty and with no dot in front.",
            )

    @property
    def relative(self) -> PurePosixPath:
        """The artifact's folder inside the store."""
        return PurePosixPath(self.dataset, self.log, f"{self.chunk:04d}", *self.stage.split("/"), self.key)

    def __str__(self) -> str:
        return str(self.relative)
