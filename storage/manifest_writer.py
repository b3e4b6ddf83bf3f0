"""Sealing a folder with its manifest, and comparing a file with what the manifest says of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from storage.files import digest_file, payload_files, sync, write_file
from storage.manifest import MANIFEST, FileEntry, Manifest


def seal(folder: Path, manifest: Callable[[tuple[FileEntry, ...]], Manifest]) -> None:
    """Sync all files, digest them, write the manifest last, sync the folders."""
    entries = []
    for name, path in payload_files(folder):
        sync(path)
        entries.append(FileEntry(path=name, sha256=digest_file(path), size=path.stat().st_size))
    write_file(folder / MANIFEST, manifest(tuple(entries)).to_json())
    sync(folder / MANIFEST)
    for below in sorted((p for p in folder.rglob("*") if p.is_dir()), reverse=True):
        sync(below)
    sync(folder)


def difference(path: Path | None, entry: FileEntry) -> str | None:
    """What is wrong with a file, or ``None``; ``path`` is ``None`` for one that is not there."""
    if path is None:
        return "A file is missing"
    try:
        size = path.lstat().st_size
        if path.is_symlink():
            return "A file is a link"
        if size != entry.size:
            return f"A file has {size} bytes, expected {entry.size}"
        return None if digest_file(path) == entry.sha256 else "A file does not have the sha256 of the manifest"
    except FileNotFoundError:
        return "A file is missing"
