"""The files of artifacts in a bucket: uploaded, checked against a listing, and brought into the read cache."""

from __future__ import annotations

import json
import re
from collections import OrderedDict
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Lock

from storage.files import write_file
from storage.io_errors import make_corruption_error
from storage.manifest import MANIFEST, FileEntry, Manifest
from storage.manifest_writer import find_damage
from storage.objects.bucket import Bucket, ObjectInfo
from storage.objects.read_cache import ReadCache
from storage.store import Artifact

PAYLOAD_START = "payload-"
"""How the folder of an artifact's files begins; the digest of the payload follows."""
ETAGS_START = "etags-"
"""How the object begins that remembers the ETags of an artifact's files."""
# By the place in the name: a log may be called anything, also as these are.
_PAYLOAD = re.compile(
    rf"(?P<artifact>(?:[^/]+/){{4,}}[^/]+)/(?:{PAYLOAD_START}[0-9a-f]{{12}}/.+|{ETAGS_START}[0-9a-f]{{12}}\.json)"
)
# More threads gain little, and a server that is slow already gets slower by them.
_THREADS = 4
# Several chunks have so many. A process that runs a dataset reads far more, each a few times soon after another.
_MAX_SOUND_FILES = 1 << 14


class _SoundFiles:
    """Files of caches that this process has found sound, so that they are not digested again; the latest ones.

    A stamp is a file's sha256, and what the system changes when the file is altered.
    """

    def __init__(self, max_count: int) -> None:
        self._max_count = max_count
        self._stamps: OrderedDict[Path, tuple[str, int, int, int]] = OrderedDict()
        # Stages of several threads read artifacts at a time.
        self._lock = Lock()

    def has(self, path: Path, stamp: tuple[str, int, int, int]) -> bool:
        """Tells whether a file was found sound with this stamp, and keeps it longer than those used less recently."""
        with self._lock:
            if self._stamps.get(path) != stamp:
                return False
            self._stamps.move_to_end(path)
            return True

    def add(self, path: Path, stamp: tuple[str, int, int, int]) -> None:
        """Remembers a sound file; the one that was used least recently goes where there are too many."""
        with self._lock:
            self._stamps[path] = stamp
            self._stamps.move_to_end(path)
            if len(self._stamps) > self._max_count:
                self._stamps.popitem(last=False)


_sound_files = _SoundFiles(_MAX_SOUND_FILES)


class Payloads:
    """The files of a store's artifacts.

    The server's ETags are remembered at the upload. A listing then shows whether a file was altered since.

    Args:
        bucket: of the store.
        cache: of what was read on this machine.
    """

    def __init__(self, bucket: Bucket, cache: ReadCache) -> None:
        self._bucket = bucket
        self._cache = cache

    def upload(self, folder: Path, manifest: Manifest) -> None:
        """Uploads the files of an artifact, several at a time.

        Args:
            folder: has the files.
            manifest: names them.

        Raises:
            OSError: a file cannot be read.
            InputError: the store must not be written.
            TransientIOError: the store does not answer.
        """
        base = _payload_folder(manifest)

        def upload(entry: FileEntry) -> str:
            return self._bucket.upload(f"{base}/{entry.path}", folder / entry.path)

        with ThreadPoolExecutor(_THREADS) as pool:
            e_tags = list(pool.map(upload, manifest.files))
        body = {entry.path: e_tag for entry, e_tag in zip(manifest.files, e_tags, strict=True)}
        self._bucket.write(_etags_name(manifest), json.dumps(body).encode())

    def remove_unlisted(self, manifest: Manifest) -> None:
        """Removes what is among the files of an artifact and not in its manifest.

        Args:
            manifest: names the files.

        Raises:
            InputError: the store must not be written.
            TransientIOError: the store does not answer.
        """
        base = _payload_folder(manifest)
        listed = {f"{base}/{entry.path}" for entry in manifest.files}
        self._bucket.delete([info.name for info in self._bucket.list(base) if info.name not in listed])

    def delete(self, manifest: Manifest) -> None:
        """Removes the files of an artifact that never came to be.

        Args:
            manifest: names them.

        Raises:
            InputError: the store must not be written.
            TransientIOError: the store does not answer.
        """
        names = [info.name for info in self._bucket.list(_payload_folder(manifest))]
        self._bucket.delete([*names, _etags_name(manifest)])

    def verify(self, artifact: Artifact, reads_all: bool = False) -> None:
        """Compares a listing with the manifest, and reads the files that it does not show to be unaltered.

        Args:
            artifact: the artifact.
            reads_all: whether every file is read, whatever its ETag is.

        Raises:
            ArtifactCorruptError: a file is missing, altered or not listed.
            TransientIOError: the store does not answer.
        """
        base = _payload_folder(artifact.manifest)
        listed = {info.name[len(base) + 1 :]: info for info in self._bucket.list(base)}
        e_tags = {} if reads_all else self._read_etags(artifact.manifest)
        # In the order of the manifest, so that the same damage is always named by the same file.
        for entry in artifact.manifest.files:
            problem = self._find_damage(entry, listed.pop(entry.path, None), e_tags.get(entry.path, ""))
            if problem:
                raise self._corruption_error(artifact, entry.path, problem)
        for name in listed:
            raise self._corruption_error(artifact, name, "A file is not in the manifest")

    def bring(self, artifact: Artifact, entries: Iterable[FileEntry], trusts_cache: bool) -> None:
        """Downloads the files that the cache lacks; each is digested on its way.

        Args:
            artifact: the artifact; its files come into ``artifact.path``.
            entries: of the files that are needed.
            trusts_cache: whether a file that this process has digested counts as present until it is written to.

        Raises:
            ArtifactCorruptError: a file is missing or altered.
            OSError: the cache cannot be written.
            TransientIOError: the store does not answer.
        """
        folder = artifact.path
        missing = [entry for entry in entries if not _is_cached(folder / entry.path, entry, trusts_cache)]
        if missing:
            folder.mkdir(parents=True, exist_ok=True)
            # At first, so that no other process makes room here while the files come.
            self._cache.mark_used(folder)
            with ThreadPoolExecutor(_THREADS) as pool:
                list(pool.map(lambda entry: self._bring_file(artifact, entry), missing))
            if not (folder / MANIFEST).exists():
                with suppress(FileExistsError):
                    write_file(folder / MANIFEST, artifact.manifest.to_json())
        self._cache.mark_used(folder)
        self._cache.make_room(sum(entry.size for entry in missing))

    def _find_damage(self, entry: FileEntry, info: ObjectInfo | None, e_tag: str) -> str | None:
        if info is None:
            return "A file is missing"
        is_unaltered = bool(e_tag) and info.e_tag == e_tag
        if is_unaltered or info.size != entry.size:
            return _describe_damage(entry, entry.sha256, info.size)
        try:
            digest, size = self._bucket.download(info.name)
        except FileNotFoundError:
            # It was removed after the listing.
            return "A file is missing"
        return _describe_damage(entry, digest, size)

    def _read_etags(self, manifest: Manifest) -> dict[str, str]:
        found = self._bucket.read(_etags_name(manifest))
        try:
            known = {} if found is None else json.loads(found.data)
            return {str(name): str(e_tag) for name, e_tag in known.items()}
        except (ValueError, AttributeError, RecursionError):
            # Then the files are read, and their digests decide.
            return {}

    def _bring_file(self, artifact: Artifact, entry: FileEntry) -> None:
        target = artifact.path / entry.path
        with self._cache.temporary() as temporary:
            part = temporary / "file"
            try:
                digest, size = self._bucket.download(f"{_payload_folder(artifact.manifest)}/{entry.path}", part)
            except FileNotFoundError as error:
                raise self._corruption_error(artifact, entry.path, "A file is missing") from error
            problem = _describe_damage(entry, digest, size)
            if problem:
                raise self._corruption_error(artifact, entry.path, problem)
            # Only now, as the folder may have gone while a large file came.
            target.parent.mkdir(parents=True, exist_ok=True)
            part.replace(target)
            self._cache.mark_used(artifact.path)

    def _corruption_error(self, artifact: Artifact, name: str, problem: str) -> Exception:
        # As people find it in the bucket, not in this machine's cache.
        file = f"{self._bucket.uri}/{_payload_folder(artifact.manifest)}/{name}"
        return make_corruption_error(artifact.address, file, problem)


def find_payload_owner(name: str) -> str | None:
    """Finds the artifact that an object is a file of.

    Args:
        name: below the store's prefix.

    Returns:
        The artifact's path, if the object is one of its files or the list of their ETags; ``None`` for a manifest and
        for all else.

    >>> find_payload_owner("d/l/0000/gnet/5f41/payload-0123456789ab/manifest.json")
    'd/l/0000/gnet/5f41'
    >>> find_payload_owner("d/payload-l/0000/gnet/5f41/manifest.json")
    """
    found = _PAYLOAD.fullmatch(name)
    return found and found["artifact"]


def _payload_folder(manifest: Manifest) -> str:
    return f"{manifest.address}/{PAYLOAD_START}{manifest.payload_digest[:12]}"


def _etags_name(manifest: Manifest) -> str:
    return f"{manifest.address}/{ETAGS_START}{manifest.payload_digest[:12]}.json"


def _describe_damage(entry: FileEntry, digest: str, size: int) -> str | None:
    if size != entry.size:
        return f"A file has {size} bytes, expected {entry.size}"
    return None if digest == entry.sha256 else "A file does not have the sha256 of the manifest"


def _is_cached(path: Path, entry: FileEntry, trusts_cache: bool) -> bool:
    try:
        status = path.lstat()
    except FileNotFoundError:
        return False
    # Taken before the digest: a file that is altered meanwhile is digested once more.
    stamp = (entry.sha256, status.st_ino, status.st_mtime_ns, status.st_ctime_ns)
    # Not the size alone, which a damaged disk or an editor may keep.
    if trusts_cache and _sound_files.has(path, stamp):
        return True
    if find_damage(path, entry) is not None:
        return False
    _sound_files.add(path, stamp)
    return True
