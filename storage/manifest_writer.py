"""Writing an artifact's folder with its manifest, and comparing files with what the manifest says of them."""

from __future__ import annotations

from dataclasses import asdict, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from storage.address import Address
from storage.codecs import get_codec
from storage.files import digest_file, payload_files, sync, write_file
from storage.manifest import MANIFEST, FileEntry, Manifest, payload_digest
from storage.store import Provenance


def write_artifact(folder: Path, address: Address, kind: str, value: Any, provenance: Provenance) -> Manifest:
    """Writes a value's files and their manifest into a folder, and pushes all to the disk.

    Args:
        folder: an empty folder.
        address: where the artifact belongs.
        kind: kind of artifact, which chooses the codec.
        value: the value.
        provenance: what the manifest says of its making.

    Returns:
        The manifest.

    Raises:
        ConfigError: no codec has this kind.
        NonFiniteError: the value does not encode.
        OSError: a file cannot be read or written.
    """
    codec = get_codec(kind)
    codec.write(folder, value)
    # Only now, once all files are known, so that the manifest can list them.
    files = list_payload(folder)
    known = {f.name: getattr(provenance, f.name) for f in fields(provenance)}
    known["created_at"] = provenance.created_at or datetime.now(UTC).isoformat(timespec="seconds")
    known["measurements"] = {**codec.measurements(value), **provenance.measurements}
    manifest = Manifest(kind=kind, files=files, payload_digest=payload_digest(files), **asdict(address), **known)
    write_manifest(folder, manifest)
    return manifest


def list_payload(folder: Path) -> tuple[FileEntry, ...]:
    """Digests the files of a folder and pushes them to the disk.

    Args:
        folder: with complete files and no manifest yet.

    Returns:
        What a manifest says of the files.

    Raises:
        OSError: a file cannot be read.
    """
    entries = []
    for name, path in payload_files(folder):
        sync(path)
        entries.append(FileEntry(path=name, sha256=digest_file(path), size=path.stat().st_size))
    return tuple(entries)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Writes the manifest of a folder whose payload is complete, and pushes both to the disk.

    Args:
        folder: the artifact's folder with its payload.
        manifest: what it says of itself.

    Raises:
        OSError: a file cannot be read or written.
    """
    write_file(folder / MANIFEST, manifest.to_json())
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


def find_damaged_file(folder: Path, manifest: Manifest) -> tuple[str, str] | None:
    """Finds the first file of a folder that is not as its manifest says.

    Args:
        folder: the artifact's folder.
        manifest: what it says of itself.

    Returns:
        (the file's name, what is wrong with it), or ``None`` where all are sound and none is unlisted.

    Raises:
        OSError: a file cannot be read.
    """
    present = dict(payload_files(folder))
    present.pop(MANIFEST, None)
    # In the order of the manifest, so that the same damage is always named by the same file.
    for entry in manifest.files:
        problem = find_damage(present.pop(entry.path, None), entry)
        if problem:
            return entry.path, problem
    for name in present:
        return name, "A file is not in the manifest"
    return None
