"""Identifies what is read of a sequence folder, so that results can be kept until any of it changes."""

from __future__ import annotations

import functools
import hashlib
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path

from genre_tasks.logs.findings import Finding

# Memory for the files of most logs. A process that runs a dataset meets far more.
_MAX_FILE_HASHES = 1 << 17
# Logs, each of which takes a hundred bytes, however many files it has.
_MAX_KNOWN_DIGESTS = 1024


class _KnownDigests:
    """Digests of the logs that were met last, by what the file system says of their files."""

    def __init__(self) -> None:
        self._digests: dict[str, str] = {}
        self._lock = threading.Lock()

    def find(self, fingerprint: str) -> str | None:
        """The digest of files that have not changed since; ``None`` where it is not known."""
        with self._lock:
            return self._digests.get(fingerprint)

    def add(self, fingerprint: str, digest: str) -> None:
        """Remembers a digest, and forgets the oldest one if there are too many."""
        with self._lock:
            self._digests[fingerprint] = digest
            if len(self._digests) > _MAX_KNOWN_DIGESTS:
                del self._digests[next(iter(self._digests))]


_known_digests = _KnownDigests()


def digest_files(root: Path, files: Iterable[Path], findings: Iterable[Finding]) -> str:
    """Identifies the name, size and content of files, and what is to be warned of.

    A file that cannot be read counts by its name and the reason: once it can be read, the digest changes. Files are
    read again only where the size or the time of change of one of them differs.

    Args:
        root: the folder that names are relative to; its own path does not count.
        files: the files that are read, in any order.
        findings: of the folder; notes do not count, since results do not repeat them.

    Returns:
        sha256, hexadecimal.
    """
    named_files = sorted((path.relative_to(root).as_posix(), path) for path in files)
    warnings = [f"{finding.word}\0{finding.message}\n" for finding in findings if finding.severity != "note"]
    # Of the log and not of each file: a log with more files than are remembered would be read at every call.
    fingerprint = _describe_state(named_files, warnings)
    known = None if fingerprint is None else _known_digests.find(fingerprint)
    if known is not None:
        return known
    total = hashlib.sha256()
    is_complete = True
    for name, path in named_files:
        try:
            line = f"{name}\0{path.stat().st_size}\0{_hash_file(path)}\n"
        except OSError as error:
            line = f"{name}\0{error.strerror}\n"
            is_complete = False
        # Lengths and separators keep two different sequences from giving the same stream of bytes. Names need not be
        # text in this system's encoding.
        total.update(line.encode(errors="surrogateescape"))
    for warning in warnings:
        total.update(warning.encode(errors="surrogateescape"))
    digest = total.hexdigest()
    # A file that could not be read may be readable at the next call, without another size or time.
    if fingerprint is not None and is_complete:
        _known_digests.add(fingerprint, digest)
    return digest


def _describe_state(named_files: Sequence[tuple[str, Path]], warnings: Iterable[str]) -> str | None:
    """Identifies files by what the system says of them; ``None`` where it says nothing of one."""
    total = hashlib.sha256()
    for name, path in named_files:
        try:
            stat = path.stat()
        except OSError:
            return None
        # The numbers of device and file tell files apart that a link led to before and leads to now.
        numbers = (stat.st_size, stat.st_mtime_ns, stat.st_dev, stat.st_ino)
        total.update(f"{name}\0{numbers}\n".encode(errors="surrogateescape"))
    for warning in warnings:
        total.update(warning.encode(errors="surrogateescape"))
    return total.hexdigest()


def _hash_file(path: Path) -> str:
    stat = path.stat()
    return _hash_content(str(path.resolve()), stat.st_size, stat.st_mtime_ns)


# A sequence has gigabytes, of which one file may change.
@functools.lru_cache(maxsize=_MAX_FILE_HASHES)
def _hash_content(path: str, size: int, mtime_ns: int) -> str:
    """sha256 of a file; size and time of change are there so that it is read again once they differ."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
