"""Writing an artifact's manifest, and comparing a file with what the manifest says of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from storage.files import digest_file, payload_files, sync, write_file
from storage.manifest import MANIFEST, FileEntry, Manifest


def write_manifest(folder: Path, make_manifest: Callable[[tuple[FileEntry, ...]], Manifest]) -> None:
    """Pushes a folder's files to the disk, digests them and writes the manifest last.

    Args:
        folder: the artifact's folder with its payload.
        make_manifest: gives the manifest for the files found.

    Raises:
        OSError: a file cannot be read or written.
    """
    entries = []
    for name, path in payload_files(folder):
        sync(path)
        entries.append(FileEntry(path=name, sha256=digest_file(path), size=path.stat().st_size))
    write_file(folder / MANIFEST, make_manifest(tuple(entries)).to_json())
    sync(folder / MANIFEST)
    # Deepest folders first: an entry must be on the disk before the folder that leads to it.
    for subfolder in sorted((p for p in folder.rglob("*") if p.is_dir()), reverse=True):
        sync(subfolder)
    sync(folder)


def find_damage(path: Path | None, entry: FileEntry) -> str | None:
    """Compares a payload file with its entry in the manifest.

    Args:
        path: the file; ``None`` for one that is not there.
        entry: what the manifest says of it.

    Returns:
        A sentence that says what is wrong, or ``None`` for a sound file.

    Raises:
        OSError: the file cannot be read.
    """
    if path is None:
        return "A file is missing"
    try:
        size = path.lstat().st_size
        # A link would make the payload depend on something outside the store.
        if path.is_symlink():
            return "A file is a link"
        # The size comes first, because a truncated file of a gigabyte need not be read to be refused.
        if size != entry.size:
            return f"A file has {size} bytes, expected {entry.size}"
        return None if digest_file(path) == entry.sha256 else "A file does not have the sha256 of the manifest"
    except FileNotFoundError:
        return "A file is missing"
