"""Durable writing: every payload byte of the store goes through :func:`write_file`."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

_BLOCK_BYTES = 1 << 20


def write_file(path: Path, data: bytes | memoryview) -> None:
    """Writes a new file completely; never overwrites one.

    Args:
        path: the new file; its folder exists.
        data: the file's bytes.

    Raises:
        OSError: the file exists or cannot be written; ``filename`` is set.
    """
    try:
        # O_EXCL: a payload file is written once; overwriting one could only hide a mistake.
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        try:
            # One call may write less than it was asked to, for instance where a quota ends.
            unwritten = memoryview(data).cast("B")
            while len(unwritten):
                unwritten = unwritten[os.write(handle, unwritten) :]
        finally:
            os.close(handle)
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def sync(path: Path) -> None:
    """Pushes a file's bytes, or a folder's entries, from the system's cache to the disk.

    Args:
        path: an existing file or folder.

    Raises:
        OSError: the disk refuses; ``filename`` is set.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        error.filename = error.filename or str(path)
        raise
    finally:
        os.close(handle)


def make_folders(path: Path) -> None:
    """Makes a folder and its parents so that their entries survive a power cut.

    Args:
        path: the folder; it may exist.

    Raises:
        OSError: a part of the path is a file, or the folder cannot be made.
    """
    new_folders = [p for p in (path, *path.parents) if not p.exists()]
    path.mkdir(parents=True, exist_ok=True)
    # A new folder is an entry of its parent: that is what has to reach the disk.
    for folder in new_folders:
        sync(folder.parent)


def digest_file(path: Path) -> str:
    """Computes a file's sha256 without reading all of it into memory.

    Args:
        path: the file.

    Returns:
        64 hex digits.

    Raises:
        OSError: the file cannot be read.
    """
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def payload_files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Lists all files below a folder, links included, without following them.

    Args:
        folder: where to look; subfolders are searched too.

    Yields:
        (path relative to the folder with "/" between parts, path), sorted.

    Raises:
        OSError: a folder that is there cannot be listed; its files would count as missing.
    """
    found: list[tuple[str, Path]] = []
    for base, names, files in os.walk(folder, onerror=_raise_unless_gone):
        # Links are listed although they are never written: a manifest that does not name them shows that one was added.
        links = [name for name in names if (Path(base) / name).is_symlink()]
        paths = [Path(base) / name for name in (*links, *files)]
        found += [(path.relative_to(folder).as_posix(), path) for path in paths]
    yield from sorted(found)


def _raise_unless_gone(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError | NotADirectoryError):
        raise error
