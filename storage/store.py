"""What any store can do. The local folder is one; an object store comes behind the same protocol."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from storage.address import Address
from storage.manifest import Manifest


@dataclass(frozen=True)
class Artifact:
    """A committed artifact: where it belongs, its folder, what its manifest says."""

    address: Address
    path: Path
    manifest: Manifest


class Store(Protocol):
    """Commits are atomic, the first writer wins, reads are verified."""

    def commit(
        self,
        address: Address,
        kind: str,
        value: Any,
        *,
        inputs: Mapping[str, str] | None = None,
        configuration: Mapping[str, Any] | None = None,
        code_digest: str = "",
        weights_digest: str | None = None,
        seconds: float = 0.0,
        peak_mib: float = 0.0,
        environment: Mapping[str, str] | None = None,
        measurements: Mapping[str, Any] | None = None,
        warnings: Sequence[str] = (),
        created_at: str | None = None,
    ) -> Artifact:
        """Write ``value`` whole or not at all; if a sound artifact is there already, that one is returned."""
        ...

    def find(self, address: Address) -> Artifact | None:
        """The artifact, or ``None``. Raises ``ArtifactCorruptError`` where its manifest cannot be trusted."""
        ...

    def verify(self, artifact: Artifact) -> None:
        """Raises ``ArtifactCorruptError`` naming the first file that is missing, unexpected or altered."""
        ...

    def read(self, artifact: Artifact) -> Any:
        """The value, after :meth:`verify`."""
        ...

    def discard(self, where: Artifact | Address) -> None:
        """Remove an artifact, sound or not; nothing happens where there is none."""
        ...

    def artifacts(
        self,
        dataset: str | None = None,
        log: str | None = None,
        chunk: int | None = None,
        stage: str | None = None,
        key: str | None = None,
        kind: str | None = None,
    ) -> Iterator[Artifact]:
        """All artifacts that fit, in the order of their paths; what has no readable manifest is passed over."""
        ...
