"""A store in a local folder: temporary name, sync, manifest last, atomic rename; the first writer wins."""

from __future__ import annotations

import os
import shutil
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

from genre_tasks.errors import ArtifactCorruptError, ConfigError
from storage.address import Address
from storage.codecs import codec_of
from storage.files import make_folders, payload_files, sync
from storage.io_errors import as_genre_error
from storage.manifest import MANIFEST, FileEntry, Manifest, NewerSchemaError, parse_manifest, payload_digest
from storage.manifest_writer import difference, seal
from storage.store import Artifact

__all__ = ["Artifact", "LocalStore", "open_store"]

_TEMPORARY, _TRASH = ".tmp-", ".trash-"
_RECOMPUTE = "Run again: it is computed anew (or delete the folder by hand)."


class LocalStore:
    """Artifacts below ``root``; see :class:`storage.store.Store`. All paths in it are relative: it can be moved."""

    def __init__(self, root: Path) -> None:
        self.root = Path(root).expanduser().absolute()

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
        """Write ``value`` whole or not at all.

        What the codec names as measurements of the value (seconds per iteration, culled counts) is added to
        ``measurements``. If a sound artifact is at ``address`` already it is kept and returned; a corrupt one is
        replaced. Raises ``ResourceError`` (disk full), ``TransientIOError``, ``InputError`` (permission),
        ``NonFiniteError`` and ``ConfigError`` (unknown kind, unfit value); nothing is left behind then.
        """
        codec = codec_of(kind)
        target = self.root / address.relative
        temporary = target.parent / f"{_TEMPORARY}{address.key[:12]}-{os.getpid()}-{uuid.uuid4().hex}"

        def manifest(files: tuple[FileEntry, ...]) -> Manifest:
            return Manifest(
                kind=kind,
                dataset=address.dataset,
                log=address.log,
                chunk=address.chunk,
                stage=address.stage,
                key=address.key,
                inputs=dict(inputs or {}),
                configuration=dict(configuration or {}),
                code_digest=code_digest,
                weights_digest=weights_digest,
                files=files,
                payload_digest=payload_digest(files),
                seconds=seconds,
                peak_mib=peak_mib,
                created_at=created_at or datetime.now(UTC).isoformat(timespec="seconds"),
                environment=dict(environment or {}),
                measurements={**codec.measurements(value), **(measurements or {})},
                warnings=tuple(warnings),
            )

        with _translated(target, address):
            try:
                make_folders(target.parent)
                temporary.mkdir()
                codec.write(temporary, value)
                seal(temporary, manifest)
                self._publish(temporary, target, address)
            finally:
                shutil.rmtree(temporary, ignore_errors=True)
            artifact = self.find(address)
        if artifact is None:
            raise _corrupt(Artifact(address, target, manifest(())), "", "The artifact vanished while it was committed")
        return artifact

    def find(self, address: Address) -> Artifact | None:
        """The artifact at ``address``, or ``None`` where there is no manifest.

        Raises ``ArtifactCorruptError`` where the manifest cannot be trusted or belongs elsewhere, and
        ``NewerSchemaError`` where a newer version wrote it.
        """
        path = self.root / address.relative
        with _translated(path, address):
            try:
                data = (path / MANIFEST).read_bytes()
            except (FileNotFoundError, NotADirectoryError):
                return None
        manifest = parse_manifest(data, path / MANIFEST)
        if manifest.address != address:
            raise ArtifactCorruptError(
                f"The manifest belongs to {manifest.address}",
                remedy=_RECOMPUTE,
                file=path / MANIFEST,
                log=address.log,
                chunk=address.chunk,
                stage=address.stage,
            )
        return Artifact(address, path, manifest)

    def verify(self, artifact: Artifact) -> None:
        """Compare every file with the manifest: there, size, sha256, and none that is not listed."""
        with _translated(artifact.path, artifact.address):
            listed = {entry.path: entry for entry in artifact.manifest.files}
            present = dict(payload_files(artifact.path))
            present.pop(MANIFEST, None)
            for name, entry in listed.items():
                problem = difference(present.get(name), entry)
                if problem:
                    raise _corrupt(artifact, name, problem)
            for name in present:
                if name not in listed:
                    raise _corrupt(artifact, name, "A file is not in the manifest")

    def read(self, artifact: Artifact) -> Any:
        """The value: digests first, then the codec with its strict checks of schema, shapes and channels."""
        self.verify(artifact)
        codec = codec_of(artifact.manifest.kind)
        with _translated(artifact.path, artifact.address):
            return codec.read(artifact.path, artifact.manifest.measurements)

    def discard(self, where: Artifact | Address) -> None:
        """Remove an artifact (sound or corrupt): renamed away first, so that nobody sees half of it.

        Raises ``NewerSchemaError`` where a newer version of the project wrote it: that is not ours to remove.
        """
        address = where.address if isinstance(where, Artifact) else where
        target = self.root / address.relative
        with _translated(target, address):
            _manifest_in(target)
            trash = _move_aside(target)
            if trash is not None:
                sync(target.parent)
                shutil.rmtree(trash, ignore_errors=True)

    def artifacts(
        self,
        dataset: str | None = None,
        log: str | None = None,
        chunk: int | None = None,
        stage: str | None = None,
        key: str | None = None,
        kind: str | None = None,
    ) -> Iterator[Artifact]:
        """All artifacts that fit, in the order of their paths; what has no sound manifest is passed over."""
        base = self.root
        for part in (dataset, log, None if chunk is None else f"{chunk:04d}", stage):
            if part is None:
                break
            base = base / part
        for folder in _folders_with_manifest(base):
            with suppress(ArtifactCorruptError, ConfigError):
                manifest = parse_manifest((folder / MANIFEST).read_bytes(), folder / MANIFEST)
                at = manifest.address
                wanted = (dataset, log, chunk, stage, key, kind)
                have = (at.dataset, at.log, at.chunk, at.stage, at.key, manifest.kind)
                if folder == self.root / at.relative and all(
                    w is None or w == h for w, h in zip(wanted, have, strict=True)
                ):
                    yield Artifact(at, folder, manifest)

    def check(self) -> Iterator[tuple[Path, ArtifactCorruptError | None]]:
        """Each folder with a manifest, in order, and what is wrong with it; also where the manifest is unreadable."""
        for folder in _folders_with_manifest(self.root):
            try:
                manifest = parse_manifest((folder / MANIFEST).read_bytes(), folder / MANIFEST)
                artifact = Artifact(manifest.address, folder, manifest)
                if folder != self.root / artifact.address.relative:
                    raise _corrupt(artifact, MANIFEST, f"The manifest belongs to {artifact.address}")
                self.verify(artifact)
                yield folder, None
            except ArtifactCorruptError as error:
                yield folder, error

    def clean_temporaries(self, older_than_s: float = 3600.0) -> int:
        """Remove what killed processes left, if nothing in it was touched for ``older_than_s``; returns how many."""
        removed = 0
        for folder, names, _ in os.walk(self.root):
            for name in [n for n in names if n.startswith((_TEMPORARY, _TRASH))]:
                names.remove(name)
                path = Path(folder) / name
                if time.time() - _last_touched(path) >= older_than_s:
                    shutil.rmtree(path, ignore_errors=True)
                    removed += 1
        return removed

    def _publish(self, temporary: Path, target: Path, address: Address) -> None:
        """Rename into place. A folder that is not empty is never overwritten by a rename, so the first one wins."""
        for _ in range(20):
            try:
                temporary.rename(target)
            except OSError:
                if not os.path.lexists(target):
                    raise
            else:
                sync(target.parent)
                return
            if self._sound(target, address):
                return
            trash = _move_aside(target)
            if trash is None:
                continue
            # Between the check and the move another writer may have put a sound one here: then it goes back.
            if self._sound(trash, address):
                with suppress(OSError):
                    trash.rename(target)
            shutil.rmtree(trash, ignore_errors=True)

    def _sound(self, path: Path, address: Address) -> bool:
        manifest = _manifest_in(path)
        if manifest is None or manifest.address != address:
            return False
        try:
            self.verify(Artifact(address, path, manifest))
            return True
        except ArtifactCorruptError:
            return False


def open_store(uri: str) -> LocalStore:
    """The store at a plain path or ``file:///…``. Raises ``ConfigError`` for any other scheme."""
    parsed = urlparse(uri)
    if parsed.scheme == "" and uri:
        return LocalStore(Path(uri))
    if parsed.scheme == "file" and parsed.netloc in ("", "localhost") and parsed.path:
        return LocalStore(Path(unquote(parsed.path)))
    raise ConfigError(f"The store {uri!r} is of no known kind", remedy="Give a folder: a path, or file:///path.")


def _manifest_in(folder: Path) -> Manifest | None:
    """The manifest, or ``None`` where there is none that can be trusted; a newer one raises."""
    try:
        return parse_manifest((folder / MANIFEST).read_bytes(), folder / MANIFEST)
    except NewerSchemaError:
        raise
    except (ArtifactCorruptError, FileNotFoundError, NotADirectoryError):
        return None


def _move_aside(target: Path) -> Path | None:
    trash = target.parent / f"{_TRASH}{uuid.uuid4().hex}"
    try:
        target.rename(trash)
    except FileNotFoundError:
        return None
    return trash


def _corrupt(artifact: Artifact, name: str, problem: str) -> ArtifactCorruptError:
    at = artifact.address
    file = artifact.path / name
    return ArtifactCorruptError(problem, remedy=_RECOMPUTE, file=file, log=at.log, chunk=at.chunk, stage=at.stage)


def _folders_with_manifest(base: Path) -> Iterator[Path]:
    for folder, names, files in os.walk(base):
        names[:] = sorted(n for n in names if not n.startswith("."))
        if MANIFEST in files:
            names.clear()
            yield Path(folder)


def _last_touched(path: Path) -> float:
    times = []
    for p in (path, *path.rglob("*")):
        with suppress(FileNotFoundError):
            times.append(p.lstat().st_mtime)
    return max(times, default=time.time())


@contextmanager
def _translated(path: Path, address: Address) -> Iterator[None]:
    """What the operating system refuses leaves as one of the project's errors."""
    try:
        yield
    except OSError as error:
        raise as_genre_error(error, path, address) from error
