"""Durable writing: every payload byte of the store goes through :func:`write_file`."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

_BLOCK = 1 << 20


def write_file(path: Path, data: bytes | memoryview) -> None:
    """Write a new file whole, or raise ``OSError`` with ``filename`` set; refuses to overwrite."""
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        try:
            rest = memoryview(data).cast("B")
            while len(rest):
                rest = rest[os.write(handle, rest) :]
        finally:
            os.close(handle)
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def sync(path: Path) -> None:
    """Push a file, or the entries of a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        error.filename = error.filename or str(path)
        raise
    finally:
        os.close(handle)


def make_folders(path: Path) -> None:
    """``mkdir -p`` whose new entries survive a power cut."""
    new = [p for p in (path, *path.parents) if not p.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for folder in new:
        sync(folder.parent)


def digest_file(path: Path) -> str:
    """sha256 (hex) of a file's bytes."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def payload_files(folder: Path) -> Iterator[tuple[str, Path]]:
    """(relative POSIX path, path) of each file below a folder, sorted; follows no links."""
    found = [(p.relative_to(folder).as_posix(), p) for p in folder.rglob("*") if p.is_symlink() or not p.is_dir()]
    yield from sorted(found)
