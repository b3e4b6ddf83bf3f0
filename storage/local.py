"""A store in a local folder: temporary name, sync, manifest last, atomic rename; the first writer wins."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from genre_tasks.errors import ArtifactCorruptError, ConfigError, GenreError, InputError, TransientIOError
from genre_tasks.progress import Progress, silent
from genre_tasks.temporary_names import describe_owner, is_abandoned, is_in_use, remove_path
from genre_tasks.user_paths import expand_user_path
from storage.address import Address
from storage.artifact_folders import (
    TEMPORARY_PREFIX,
    TRASH_PREFIX,
    find_artifact_folders,
    find_hidden,
    find_sound_manifest,
    last_modified,
    load_manifest,
    move_to_trash,
    walk_artifact_folders,
)
from storage.codecs import get_codec
from storage.file_lease import hold_file_lease
from storage.files import make_folders, sync, write_file
from storage.io_errors import as_genre_error, make_corruption_error, os_errors_translated
from storage.manifest import MANIFEST, Manifest, parse_manifest
from storage.manifest_writer import find_damaged_file, write_artifact, write_manifest
from storage.records import LocalRecordFolders
from storage.store import Artifact, Provenance

__all__ = ["Artifact", "LocalStore", "Provenance"]

# Every further attempt needs another writer that leaves a damaged artifact at the same moment.
_PUBLISH_ATTEMPTS = 20


class LocalStore:
    """Artifacts in folders below ``root``; the methods of :class:`storage.store.Store` are documented there.

    All paths inside the store are relative, so that its folder can be moved or copied.

    Attributes:
        root: the store's folder; it is made by the first commit.
    """

    def __init__(self, root: Path) -> None:
        self.root = expand_user_path(root).absolute()
        self.records = LocalRecordFolders(self.root)

    @property
    def uri(self) -> str:
        """The folder's path."""
        return str(self.root)

    @property
    def scratch_folder(self) -> Path:
        """The store's own folder: see :attr:`storage.store.Store.scratch_folder`."""
        make_folders(self.root)
        return self.root

    def check_writable(self) -> None:
        """Writes and removes a small file: see :meth:`storage.store.Store.check_writable`."""
        probe = self.root / f"{TEMPORARY_PREFIX}probe-{describe_owner()}-{uuid.uuid4().hex}"
        try:
            make_folders(self.root)
            write_file(probe, b"\0")
            probe.unlink()
        except OSError as error:
            raise as_genre_error(error, self.root) from error

    def exists(self) -> bool:
        """Tells whether the folder is there: see :meth:`storage.store.Store.exists`."""
        return self.root.is_dir()

    def commit(self, address: Address, kind: str, value: Any, provenance: Provenance | None = None) -> Artifact:
        """Writes a value to a temporary folder and renames it into place: see :meth:`storage.store.Store.commit`.

        Returns:
            The artifact that is now at ``address``.
        """
        known = provenance or Provenance()
        return self._publish_folder(address, lambda folder: write_artifact(folder, address, kind, value, known))

    def adopt(self, manifest: Manifest, folder: Path) -> Artifact:
        """Takes in an artifact's files as another store has them: see :meth:`storage.store.Store.adopt`.

        Returns:
            The artifact that is now at the manifest's address.
        """

        def copy(temporary: Path) -> Manifest:
            for entry in manifest.files:
                target = temporary / entry.path
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(folder / entry.path, target)
                sync(target)
            write_manifest(temporary, manifest)
            damage = find_damaged_file(temporary, manifest)
            if damage is not None:
                raise make_corruption_error(manifest.address, folder / damage[0], damage[1])
            return manifest

        return self._publish_folder(manifest.address, copy)

    def _publish_folder(self, address: Address, write: Callable[[Path], Manifest]) -> Artifact:
        """Has a temporary folder written and renames it into place."""
        target = self.root / address.relative_path
        # Beside the target, because a rename is atomic only within one file system. The owner tells whether a folder
        # is still in use, the random part keeps two writers of one process apart.
        name = f"{TEMPORARY_PREFIX}{address.key[:12]}-{describe_owner()}-{uuid.uuid4().hex}"
        temporary = target.parent / name
        with os_errors_translated(target, address):
            try:
                make_folders(target.parent)
                temporary.mkdir()
                write(temporary)
                self._publish(temporary, target, address)
            finally:
                # After the rename nothing is left here; after an error nothing may stay.
                shutil.rmtree(temporary, ignore_errors=True)
            artifact = self.find(address)
        if artifact is None:
            raise make_corruption_error(address, target, "The artifact vanished while it was committed")
        return artifact

    def find(self, address: Address) -> Artifact | None:
        """Looks an artifact up by its manifest: see :meth:`storage.store.Store.find`.

        Returns:
            The artifact, or ``None``.
        """
        path = self.root / address.relative_path
        with os_errors_translated(path, address):
            try:
                data = (path / MANIFEST).read_bytes()
            except (FileNotFoundError, NotADirectoryError):
                return None
        manifest = parse_manifest(data, path / MANIFEST)
        # A folder that someone moved or copied by hand would otherwise pass for another artifact.
        if manifest.address != address:
            raise make_corruption_error(address, path / MANIFEST, f"The manifest belongs to {manifest.address}")
        return Artifact(address, path, manifest)

    def verify(self, artifact: Artifact, reads_all: bool = False) -> None:
        """Reads every file, whatever ``reads_all`` is, and checks that none is there which is not listed.

        Raises:
            ArtifactCorruptError: as :meth:`storage.store.Store.verify` says.
        """
        with os_errors_translated(artifact.path, artifact.address):
            damage = find_damaged_file(artifact.path, artifact.manifest)
        if damage is not None:
            raise make_corruption_error(artifact.address, artifact.path / damage[0], damage[1])

    def read(self, artifact: Artifact) -> Any:
        """Reads an artifact's value: digests first, then the codec with its strict checks.

        Returns:
            The value: see :meth:`storage.store.Store.read`.
        """
        self.verify(artifact)
        # After the digests, so that decoders never see bytes that the codec did not write.
        codec = get_codec(artifact.manifest.kind)
        with os_errors_translated(artifact.path, artifact.address):
            return codec.read(artifact.path, artifact.manifest.measurements)

    def fetch(self, artifact: Artifact, suffix: str = "") -> Path:
        """Gives the folder of an artifact's files: see :meth:`storage.store.Store.fetch`.

        Returns:
            The artifact's folder in the store.
        """
        return artifact.path

    def lease(self, address: Address, progress: Progress = silent) -> AbstractContextManager[None]:
        """Keeps others from computing an artifact: see :meth:`storage.store.Store.lease`.

        Returns:
            The context in which this process alone computes it.
        """
        return hold_file_lease(self.root, address, progress)

    def discard(self, target: Artifact | Address) -> None:
        """Removes an artifact, renamed away first so that nobody sees half of it.

        Raises:
            NewerSchemaError: as :meth:`storage.store.Store.discard` says.
        """
        address = target.address if isinstance(target, Artifact) else target
        folder = self.root / address.relative_path
        with os_errors_translated(folder, address):
            # It raises where a newer version wrote it: that is not ours to remove.
            manifest = find_sound_manifest(folder)
            if isinstance(target, Artifact) and manifest is not None and manifest != target.manifest:
                # Another process has replaced it already.
                return
            trash = move_to_trash(folder)
            if trash is not None:
                sync(folder.parent)
                shutil.rmtree(trash, ignore_errors=True)

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
        """Lists the artifacts that fit, in the order of their paths.

        Yields:
            Artifacts with a sound manifest: see :meth:`storage.store.Store.artifacts`.
        """
        base = self.root
        # The known start of the path narrows the search; the rest is compared below.
        for part in (dataset, log, None if chunk is None else f"{chunk:04d}", stage):
            if part is None:
                break
            base = base / part
        wanted = {"dataset": dataset, "log": log, "chunk": chunk, "stage": stage, "key": key, "kind": kind}
        for folder in find_artifact_folders(base):
            # A folder is named by its key, so that the manifests of all others need not be read.
            if not folder.name.startswith(key or key_start):
                continue
            # A damaged artifact must not hide the sound ones after it; `verify_all` reports it.
            try:
                manifest = load_manifest(folder)
                address = manifest.address
                is_in_place = folder == self.root / address.relative_path
            except (ArtifactCorruptError, ConfigError, FileNotFoundError):
                # One that is gone was discarded by another process since its folder was listed.
                continue
            except OSError as error:
                raise as_genre_error(error, folder / MANIFEST) from error
            if is_in_place and all(v is None or v == getattr(manifest, name) for name, v in wanted.items()):
                yield Artifact(address, folder, manifest)

    def verify_all(self) -> Iterator[tuple[str, GenreError | None]]:
        """Checks every artifact of the store: see :meth:`storage.store.Store.verify_all`.

        Yields:
            (relative path, what is wrong with it or ``None``).
        """
        for folder, fault in walk_artifact_folders(self.root):
            name = folder.relative_to(self.root).as_posix()
            if fault is not None:
                yield name, fault
                continue
            try:
                # A file that cannot be read must not hide what is wrong with those after it.
                with os_errors_translated(folder / MANIFEST, None):
                    manifest = load_manifest(folder)
                artifact = Artifact(manifest.address, folder, manifest)
                if folder != self.root / artifact.address.relative_path:
                    raise make_corruption_error(artifact.address, folder, f"The manifest belongs to {artifact.address}")
                self.verify(artifact)
                yield name, None
            except (ArtifactCorruptError, InputError, TransientIOError) as error:
                yield name, error

    def clean_temporaries(self, older_than_s: float = 3600.0, everywhere: bool = False) -> int:
        """Removes what killed processes left behind.

        Args:
            older_than_s: folders of other machines, whose processes cannot be asked for, go when nothing in them was
                touched for so many seconds by the file system's clock.
            everywhere: makes no difference for a folder.

        Returns:
            How many files and folders were removed.
        """
        removed = 0
        now = _read_file_system_clock(self.root)
        for path in find_hidden(self.root):
            is_temporary = path.name.startswith((TEMPORARY_PREFIX, TRASH_PREFIX))
            # A process that was suspended for long goes on afterwards.
            # Whose owner lives is asked first: the folder's files come and go then.
            is_old = is_temporary and not is_in_use(path) and now - last_modified(path) >= older_than_s
            if is_old or is_abandoned(path):
                remove_path(path)
                removed += 1
        return removed

    def _publish(self, temporary: Path, target: Path, address: Address) -> None:
        """Renames into place, where the first sound artifact stays."""
        # A loop, because another writer may come or go between any two of these calls.
        for _ in range(_PUBLISH_ATTEMPTS):
            try:
                # A rename never overwrites a folder that is not empty, so the first writer wins.
                temporary.rename(target)
            except OSError:
                if not os.path.lexists(target):
                    raise
            else:
                sync(target.parent)
                return
            if self._is_sound(target, address):
                return
            trash = move_to_trash(target)
            if trash is None:
                continue
            # Between the check and the move another writer may have put a sound one here: then it goes back.
            if self._is_sound(trash, address):
                with suppress(OSError):
                    trash.rename(target)
            shutil.rmtree(trash, ignore_errors=True)

    def _is_sound(self, path: Path, address: Address) -> bool:
        manifest = find_sound_manifest(path)
        if manifest is None or manifest.address != address:
            return False
        try:
            self.verify(Artifact(address, path, manifest))
            return True
        except ArtifactCorruptError:
            return False


def _read_file_system_clock(folder: Path) -> float:
    """Reads the clock that stamps files there, which on a server may differ from this machine's."""
    try:
        with tempfile.TemporaryFile(dir=folder) as probe:
            return os.fstat(probe.fileno()).st_mtime
    except OSError:
        # Where nothing can be written, nothing can be removed either.
        return time.time()
