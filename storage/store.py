"""What any store can do, whether it is a folder of this machine or a bucket of an object store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from genre_tasks.errors import GenreError
from genre_tasks.progress import Progress, silent
from storage.address import Address
from storage.manifest import Manifest
from storage.records import RecordFolders


@dataclass(frozen=True)
class Artifact:
    """A committed artifact.

    Attributes:
        address: where it belongs.
        path: where its files are on this machine, which for a remote store is true only after :meth:`Store.fetch`.
        manifest: what it says of itself.
    """

    address: Address
    path: Path
    manifest: Manifest


@dataclass(frozen=True)
class Provenance:
    """How a value was made: what its manifest says beside the payload.

    Attributes:
        inputs: name → key of each input artifact (or digest of the log).
        configuration: the stage's section of the configuration, as JSON values.
        code_digest: digest of the stage's code.
        weights_digest: digest of the network's weights, if the stage has a network.
        seconds: wall time of the stage.
        peak_mib: largest memory of the process during the stage, in MiB.
        environment: versions, machine and commit.
        measurements: numbers and facts about the result that are no payload.
        warnings: sentences for the user.
        created_at: time of the commit, ISO 8601; by default now.
    """

    inputs: Mapping[str, str] = field(default_factory=dict)
    configuration: Mapping[str, Any] = field(default_factory=dict)
    code_digest: str = ""
    weights_digest: str | None = None
    seconds: float = 0.0
    peak_mib: float = 0.0
    environment: Mapping[str, str] = field(default_factory=dict)
    measurements: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    created_at: str | None = None


class Store(Protocol):
    """A place for artifacts: commits are atomic, the first writer wins, reads are verified."""

    @property
    def uri(self) -> str:
        """Where the store is: a path or a URI, without credentials."""
        ...

    @property
    def records(self) -> RecordFolders:
        """The records of runs and datasets."""
        ...

    @property
    def scratch_folder(self) -> Path:
        """A folder on a disk of this machine, for files that live no longer than a stage."""
        ...

    def check_writable(self) -> None:
        """Writes and removes a small file.

        Raises:
            InputError: this user may not write there.
            ResourceError: the disk is full.
            TransientIOError: the store does not answer.
        """
        ...

    def exists(self) -> bool:
        """Tells whether anything was ever written to the store.

        Raises:
            TransientIOError: the store does not answer.
        """
        ...

    def commit(self, address: Address, kind: str, value: Any, provenance: Provenance | None = None) -> Artifact:
        """Writes a value completely or not at all.

        Args:
            address: where it belongs. A sound artifact that is there already stays; a corrupt one is replaced.
            kind: kind of artifact, which chooses the codec (:data:`storage.codecs.KINDS`).
            value: what the codec writes. What the codec calls measurements is added to those of ``provenance``.
            provenance: how the value was made; by default nothing is known of it.

        Returns:
            The artifact that is now at ``address``.

        Raises:
            ConfigError: the kind is unknown, or the value breaks the codec's contract.
            NonFiniteError: the value holds NaN or infinity where it must not.
            ResourceError: the disk is full. ``TransientIOError`` and ``InputError`` are raised for other faults.
        """
        ...

    def adopt(self, manifest: Manifest, folder: Path) -> Artifact:
        """Takes in an artifact's files as another store has them, completely or not at all.

        Args:
            manifest: what the artifact says of itself; it is written unchanged.
            folder: has the payload's files, which are copied and checked.

        Returns:
            The artifact that is now at the manifest's address, also where another was there before.

        Raises:
            ArtifactCorruptError: a file is missing or altered.
            InputError: the store cannot be written.
            ResourceError: the disk is full.
            TransientIOError: the store does not answer.
        """
        ...

    def find(self, address: Address) -> Artifact | None:
        """Looks an artifact up without reading its payload.

        Args:
            address: where it belongs.

        Returns:
            The artifact, or ``None`` where there is no manifest.

        Raises:
            NewerSchemaError: a newer version of the project wrote the manifest.
            ArtifactCorruptError: the manifest cannot be trusted, or belongs to another address.
        """
        ...

    def verify(self, artifact: Artifact, reads_all: bool = False) -> None:
        """Compares every file of an artifact with its manifest.

        Args:
            artifact: the artifact to check.
            reads_all: whether every byte is read. Otherwise a bucket's listing is trusted where it shows a file to be
                as it was uploaded; a folder's files are always read.

        Raises:
            ArtifactCorruptError: a file is missing, unexpected or altered; it is named.
        """
        ...

    def read(self, artifact: Artifact) -> Any:
        """Reads an artifact's value, after :meth:`verify`.

        Args:
            artifact: the artifact to read.

        Returns:
            The value that was committed.

        Raises:
            ArtifactCorruptError: a file is damaged, or the codec finds another schema, shape or channel.
        """
        ...

    def fetch(self, artifact: Artifact, suffix: str = "") -> Path:
        """Brings an artifact's files to this machine, for a reader of single files.

        Files of a remote store are verified, also where they are on this machine already; a local store's are used as
        they are.

        Args:
            artifact: the artifact.
            suffix: how the names of the files end that are needed; by default all.

        Returns:
            The folder with its files, for reading only. It is ``artifact.path``.

        Raises:
            ArtifactCorruptError: a file that was brought is missing or altered.
            TransientIOError: the store does not answer.
        """
        ...

    def lease(self, address: Address, progress: Progress = silent) -> AbstractContextManager[None]:
        """Gives the exclusive right to compute an artifact, and waits for it while another process has it.

        A process that dies loses its lease. Commits are safe without one: a lease only saves doubled work.
        A process that had to wait looks the artifact up again.

        Args:
            address: of the artifact.
            progress: called while another process has the lease.

        Returns:
            The context in which this process alone computes the artifact.

        Raises:
            InputError: the store cannot be written.
            TransientIOError: the store does not answer.
        """
        ...

    def discard(self, target: Artifact | Address) -> None:
        """Removes an artifact, sound or not; nothing happens where there is none.

        Args:
            target: the artifact, which stays where another one has replaced it; or the address of any.

        Raises:
            NewerSchemaError: a newer version of the project wrote it; it is not removed.
        """
        ...

    def artifacts(
        self,
        dataset: str | None = None,
        log: str | None = None,
        chunk: int | None = None,
        stage: str | None = None,
        key: str | None = None,
        kind: str | None = None,
        key_start: str = "",
    ) -> Iterator[Artifact]:
        """Lists artifacts in the order of their paths; what has a damaged manifest is left out.

        Args:
            dataset: only artifacts of this dataset; ``None``, here and below, for any.
            log: only of this log.
            chunk: only of this chunk.
            stage: only of this stage.
            key: only with this key.
            kind: only of this kind.
            key_start: only with a key that begins so.

        Yields:
            The artifacts that fit.

        Raises:
            InputError: a folder must not be listed, or a manifest must not be read.
            TransientIOError: the store does not answer.
        """
        ...

    def verify_all(self) -> Iterator[tuple[str, GenreError | None]]:
        """Checks every byte of every artifact, also of those whose manifest cannot be read.

        Yields:
            (the path relative to the store of an artifact, or of a folder that cannot be listed; what is wrong with it
            or ``None``), in the order of the paths.
            It is damaged only where that is an ``ArtifactCorruptError``; with any other error it cannot be read now.
        """
        ...

    def clean_temporaries(self, older_than_s: float = 3600.0, everywhere: bool = False) -> int:
        """Removes what killed processes left behind.

        Args:
            older_than_s: what cannot be attributed to a process goes when it was not touched for so many seconds.
            everywhere: whether a bucket is listed as well, which takes long for a large one.

        Returns:
            How many files and folders were removed.
        """
        ...
