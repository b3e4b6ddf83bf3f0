"""The store in a bucket: a manifest that is put if absent is the commit."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from genre_tasks.cache_folder import find_cache_folder
from genre_tasks.errors import ArtifactCorruptError, ConfigError, GenreError, InputError, TransientIOError
from genre_tasks.progress import Progress, silent
from genre_tasks.temporary_names import describe_owner
from storage.address import Address
from storage.codecs import get_codec
from storage.io_errors import make_corruption_error, os_errors_translated
from storage.manifest import MANIFEST, Manifest, NewerSchemaError, parse_manifest
from storage.manifest_writer import find_damage, write_artifact
from storage.objects.abandoned import PROBE_START, find_abandoned
from storage.objects.bucket import Bucket, ObjectVersion
from storage.objects.manifest_listing import ManifestListing
from storage.objects.object_lease import hold_object_lease
from storage.objects.object_records import ObjectRecordFolders
from storage.objects.payloads import Payloads
from storage.objects.read_cache import ReadCache, read_limit_bytes
from storage.store import Artifact, Provenance

_PUBLISH_ATTEMPTS = 5


class ObjectStore:
    """A store in a bucket; implements :class:`storage.store.Store`.

    An artifact is ``ADDRESS/manifest.json``, ``ADDRESS/payload-DIGEST/FILE`` and ``ADDRESS/etags-DIGEST.json``. Writers
    of other bytes write to another payload folder, and so never mix.

    Args:
        uri: such as ``s3://bucket/prefix``.

    Raises:
        ConfigError: the URI names no bucket, or holds credentials; or a variable of the environment is wrong.
    """

    def __init__(self, uri: str) -> None:
        self._bucket = Bucket(uri)
        name = hashlib.sha256(self._bucket.uri.encode()).hexdigest()[:12]
        folder = find_cache_folder() / name
        self._cache = ReadCache(folder, read_limit_bytes())
        self._payloads = Payloads(self._bucket, self._cache)
        self._manifests = ManifestListing(self._bucket, self._cache)
        self.records = ObjectRecordFolders(self._bucket, folder / "records")

    @property
    def uri(self) -> str:
        """The URI, without credentials."""
        return self._bucket.uri

    @property
    def scratch_folder(self) -> Path:
        """Where downloaded objects are, too: see :attr:`storage.store.Store.scratch_folder`."""
        return find_cache_folder()

    def check_writable(self) -> None:
        """Writes and removes a small object: see :meth:`storage.store.Store.check_writable`."""
        self._bucket.delete([self._write_probe()])

    def exists(self) -> bool:
        """Tells whether anything was ever written: see :meth:`storage.store.Store.exists`."""
        return next(self._bucket.list(), None) is not None

    def commit(self, address: Address, kind: str, value: Any, provenance: Provenance | None = None) -> Artifact:
        """Uploads a value's files, then puts the manifest if there is none: see :meth:`storage.store.Store.commit`.

        Returns:
            The artifact that is now at ``address``.
        """
        with os_errors_translated(self._cache.folder, address), self._cache.temporary() as temporary:
            manifest = write_artifact(temporary, address, kind, value, provenance or Provenance())
            artifact = self._publish(temporary, manifest)
            if artifact.manifest == manifest:
                # The next stage reads it on this machine: it need not come back over the network.
                self._cache.keep(temporary, artifact.path)
            return artifact

    def adopt(self, manifest: Manifest, folder: Path) -> Artifact:
        """Takes in an artifact's files as another store has them: see :meth:`storage.store.Store.adopt`.

        Returns:
            The artifact that is now at the manifest's address.
        """
        with os_errors_translated(folder, manifest.address):
            for entry in manifest.files:
                problem = find_damage(folder / entry.path, entry)
                if problem:
                    raise make_corruption_error(manifest.address, folder / entry.path, problem)
            return self._publish(folder, manifest)

    def find(self, address: Address) -> Artifact | None:
        """Looks an artifact up by its manifest: see :meth:`storage.store.Store.find`.

        Returns:
            The artifact, or ``None``.
        """
        name = f"{address}/{MANIFEST}"
        found = self._bucket.read(name)
        return None if found is None else self._make_artifact(address, found.data)

    def verify(self, artifact: Artifact, reads_all: bool = False) -> None:
        """Checks an artifact by a listing, and by its bytes where these may be altered: see :meth:`Store.verify`.

        A disk of the server may damage bytes under an ETag that stays; only ``reads_all`` finds that.

        Raises:
            ArtifactCorruptError: as :meth:`storage.store.Store.verify` says.
        """
        self._payloads.verify(artifact, reads_all)

    def read(self, artifact: Artifact) -> Any:
        """Brings an artifact's files to this machine, digests them and decodes them: see :meth:`Store.read`.

        Returns:
            The value: see :meth:`storage.store.Store.read`.
        """
        codec = get_codec(artifact.manifest.kind)
        with os_errors_translated(artifact.path, artifact.address):
            for _ in range(_PUBLISH_ATTEMPTS):
                # Another process may make room just now.
                with suppress(FileNotFoundError):
                    self._payloads.bring(artifact, artifact.manifest.files, trusts_cache=False)
                    return codec.read(artifact.path, artifact.manifest.measurements)
            raise make_corruption_error(artifact.address, artifact.path, "The cache loses the artifact's files")

    def fetch(self, artifact: Artifact, suffix: str = "") -> Path:
        """Brings files of an artifact to this machine: see :meth:`storage.store.Store.fetch`.

        Returns:
            Their folder in the cache.
        """
        wanted = [entry for entry in artifact.manifest.files if entry.path.endswith(suffix)]
        with os_errors_translated(artifact.path, artifact.address):
            self._payloads.bring(artifact, wanted, trusts_cache=True)
        return artifact.path

    def lease(self, address: Address, progress: Progress = silent) -> AbstractContextManager[None]:
        """Keeps others from computing an artifact: see :meth:`storage.store.Store.lease`.

        Returns:
            The context in which this process alone computes it.
        """
        return hold_object_lease(self._bucket, address, progress)

    def discard(self, target: Artifact | Address) -> None:
        """Removes an artifact, its manifest first so that nobody sees half of it.

        Raises:
            NewerSchemaError: as :meth:`storage.store.Store.discard` says.
        """
        address = target.address if isinstance(target, Artifact) else target
        # Before the manifest goes: a writer that comes then must not lose its files.
        names = [info.name for info in self._bucket.list(str(address))]
        try:
            found = self.find(address)
            if isinstance(target, Artifact) and found is not None and found.manifest != target.manifest:
                # Another process has replaced it already.
                return
        except NewerSchemaError:
            # It is not ours to remove.
            raise
        except ArtifactCorruptError:
            pass
        manifest = f"{address}/{MANIFEST}"
        self._bucket.delete([manifest])
        self._bucket.delete([name for name in names if name != manifest])

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
        parts = []
        # The known start of the path narrows the search; the rest is compared below.
        for part in (dataset, log, None if chunk is None else f"{chunk:04d}", stage):
            if part is None:
                break
            parts.append(part)
        wanted = {"dataset": dataset, "log": log, "chunk": chunk, "stage": stage, "key": key, "kind": kind}
        infos = self._manifests.find("/".join(parts), key or key_start)
        for info, data in self._manifests.read_all(infos):
            # A damaged artifact must not hide the sound ones after it; `verify_all` reports it.
            with suppress(ArtifactCorruptError, ConfigError):
                artifact = self._make_artifact(None, data, info.name)
                if all(v is None or v == getattr(artifact.manifest, name) for name, v in wanted.items()):
                    yield artifact

    def verify_all(self) -> Iterator[tuple[str, GenreError | None]]:
        """Reads every byte of every artifact: see :meth:`storage.store.Store.verify_all`.

        Yields:
            (relative path, what is wrong with it or ``None``).

        Raises:
            InputError: the store must not be listed.
            TransientIOError: the store does not answer.
        """
        for info, data in self._manifests.try_read_all(self._manifests.find()):
            name = info.name.removesuffix(f"/{MANIFEST}")
            error = self._find_fault(info.name, data)
            yield name, error
            if isinstance(error, TransientIOError):
                # One object may be away for itself. A server that is away must not be waited for at every artifact.
                self.exists()

    def clean_temporaries(self, older_than_s: float = 3600.0, everywhere: bool = False) -> int:
        """Removes this machine's temporary folders, payloads without a manifest, and leases that nobody renews.

        Args:
            older_than_s: objects go when they were written so many seconds ago or earlier.
            everywhere: whether objects go too. The whole bucket is then listed.

        Returns:
            How many objects and folders were removed.
        """
        removed = self._cache.clean_temporaries()
        if not everywhere:
            return removed
        probe = self._write_probe()
        try:
            old = find_abandoned(self._bucket, probe, older_than_s)
            self._bucket.delete(old)
        finally:
            self._bucket.delete([probe])
        return removed + len(old)

    def _find_fault(self, name: str, data: bytes | GenreError) -> GenreError | None:
        """What is wrong with an artifact, or why it cannot be read; ``data`` is what came of its manifest."""
        if isinstance(data, GenreError):
            return data
        try:
            self._payloads.verify(self._make_artifact(None, data, name), reads_all=True)
        except (ArtifactCorruptError, InputError, TransientIOError) as error:
            return error
        return None

    def _write_probe(self) -> str:
        name = f"{PROBE_START}{describe_owner()}-{uuid.uuid4().hex}"
        self._bucket.write(name, b"\0")
        return name

    def _publish(self, folder: Path, manifest: Manifest) -> Artifact:
        """Uploads a folder's files and puts the manifest, where the first sound artifact stays."""
        address = manifest.address
        problem: ArtifactCorruptError | None = None
        # A loop, because another writer may come or go between any two of these calls.
        for _ in range(_PUBLISH_ATTEMPTS):
            found, damaged = self._find_sound(address)
            if found is not None:
                return found
            if damaged is not None:
                self._payloads.remove_unlisted(manifest)
            self._payloads.upload(folder, manifest)
            artifact = self._make_artifact(address, manifest.to_json())
            try:
                self._payloads.verify(artifact)
            except ArtifactCorruptError as error:
                # A truncated upload must never become an artifact.
                problem = error
                continue
            if not self._put_manifest(manifest, damaged):
                winner, _ = self._find_sound(address)
                if winner is not None and winner.manifest.payload_digest != manifest.payload_digest:
                    self._payloads.delete(manifest)
        found, _ = self._find_sound(address)
        if found is None:
            raise TransientIOError(
                f"the store does not keep what is written: {problem or 'the artifact vanishes'}",
                remedy="Check the server's disk and log; then run again.",
                file=f"{self.uri}/{address}",
            ) from problem
        return found

    def _put_manifest(self, manifest: Manifest, damaged: ObjectVersion | None) -> bool:
        """Puts a manifest where there is none, or only this damaged one: another writer's is never replaced."""
        name = f"{manifest.address}/{MANIFEST}"
        if damaged is None:
            return self._bucket.create(name, manifest.to_json()) is not None
        return self._bucket.replace(name, manifest.to_json(), damaged) is not None

    def _find_sound(self, address: Address) -> tuple[Artifact | None, ObjectVersion | None]:
        """The artifact at an address, or the version of a damaged one's manifest."""
        content = self._bucket.read(f"{address}/{MANIFEST}")
        if content is None:
            return None, None
        try:
            artifact = self._make_artifact(address, content.data)
            self.verify(artifact)
            return artifact, None
        except NewerSchemaError:
            raise
        except ArtifactCorruptError:
            return None, content.version

    def _make_artifact(self, address: Address | None, data: bytes, name: str = "") -> Artifact:
        """Parses a manifest that must be of the address, or of the object's name."""
        place = str(address) if address is not None else name.removesuffix(f"/{MANIFEST}")
        manifest = parse_manifest(data, Path(place) / MANIFEST)
        if str(manifest.address) != place:
            raise make_corruption_error(
                manifest.address, f"{self.uri}/{place}/{MANIFEST}", f"The manifest belongs to {manifest.address}"
            )
        path = self._cache.find_folder(manifest.address, manifest.payload_digest)
        return Artifact(manifest.address, path, manifest)
