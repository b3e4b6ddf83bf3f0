"""Where an artifact lies: ``<dataset>/<log>/<chunk>/<stage>/<key>/``, a layout a person can walk."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

from genre_tasks.errors import ConfigError

_FOLDER_NAME = re.compile(r"[^\x00-\x1f\x7f/\\]{1,200}")

# Dataset, log, chunk, stage and key; a stage may have more.
_FEWEST_PARTS = 5


@dataclass(frozen=True, order=True)
class Address:
    """Coordinates of one artifact in a store.

    Attributes:
        dataset: name of the dataset, such as ``pandaset``.
        log: name of the driving log.
        chunk: index of the chunk in the log, from 0.
        stage: name of the stage. It may hold "/" (``evaluate/gnet``), which makes folders of it.
        key: digest over everything that the stage's result depends on.

    Raises:
        ConfigError: a part cannot be a folder's name, or the chunk is negative.

    >>> print(Address("pandaset", "002", 0, "evaluate/gnet", "5f41af0e"))
    pandaset/002/0000/evaluate/gnet/5f41af0e
    """

    dataset: str
    log: str
    chunk: int
    stage: str
    key: str

    def __post_init__(self) -> None:
        # An empty or hidden name, "..", a slash or a control character could lead out of the store.
        for name, part in (("dataset", self.dataset), ("log", self.log), ("key", self.key)):
            self._check(name, part)
        for part in self.stage.split("/"):
            self._check("stage", part)
        if self.chunk < 0:
            raise ConfigError(f"Chunk {self.chunk} is negative", remedy="Chunks count from 0.", log=self.log)

    def _check(self, name: str, part: str) -> None:
        if not _FOLDER_NAME.fullmatch(part) or part.startswith("."):
            raise ConfigError(
                f"The {name} {part!r} cannot be a folder's name",
                remedy="Use letters, digits, and any of - _ = + . inside; not empty and with no dot in front.",
            )

    @classmethod
    def parse(cls, text: str) -> Address:
        """Reads an address as :meth:`__str__` writes it.

        Args:
            text: such as ``pandaset/002/0000/gnet/5f41af0e``.

        Returns:
            The address.

        Raises:
            ConfigError: the text is no address.

        >>> Address.parse("pandaset/002/0000/evaluate/gnet/5f41af0e").stage
        'evaluate/gnet'
        """
        parts = text.split("/")
        if len(parts) < _FEWEST_PARTS or not parts[2].isdecimal():
            raise ConfigError(f"{text!r} is no address", remedy="Write it as dataset/log/chunk/stage/key.")
        return cls(parts[0], parts[1], int(parts[2]), "/".join(parts[3:-1]), parts[-1])

    @property
    def relative_path(self) -> PurePosixPath:
        """The artifact's folder, relative to the store's root."""
        # Four digits, so that folders sort as numbers do.
        return PurePosixPath(self.dataset, self.log, f"{self.chunk:04d}", *self.stage.split("/"), self.key)

    def __str__(self) -> str:
        return str(self.relative_path)
