"""Identifies what is read of a sequence folder, so that results can be kept until any of it changes."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable
from pathlib import Path

from genre_tasks.logs.findings import Finding

# More than any sequence has files. A process that runs a dataset meets far more.
_MAX_FILE_HASHES = 1 << 17


def digest_files(root: Path, files: Iterable[Path], findings: Iterable[Finding]) -> str:
    """Identifies the name, size and content of files, and what is to be warned of.

    A file that cannot be read counts by its name and the reason: once it can be read, the digest changes.

    Args:
        root: the folder that names are relative to; its own path does not count.
        files: the files that are read, in any order.
        findings: of the folder; notes do not count, since results do not repeat them.

    Returns:
        sha256, hexadecimal.
    """
    total = hashlib.sha256()
    for name, path in sorted((path.relative_to(root).as_posix(), path) for path in files):
        try:
            line = f"{name}\0{path.stat().st_size}\0{_hash_file(path)}\n"
        except OSError as error:
            line = f"{name}\0{error.strerror}\n"
        # Lengths and separators keep two different sequences from giving the same stream of bytes. Names need not be
        # text in this system's encoding.
        total.update(line.encode(errors="surrogateescape"))
    for finding in findings:
        if finding.severity != "note":
            total.update(f"{finding.word}\0{finding.message}\n".encode(errors="surrogateescape"))
    return total.hexdigest()


def _hash_file(path: Path) -> str:
    stat = path.stat()
    return _hash_content(str(path.resolve()), stat.st_size, stat.st_mtime_ns)


# A sequence has gigabytes, and its digest is asked for again and again.
@functools.lru_cache(maxsize=_MAX_FILE_HASHES)
def _hash_content(path: str, size: int, mtime_ns: int) -> str:
    """sha256 of a file; size and time of change are there so that it is read again once they differ."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
