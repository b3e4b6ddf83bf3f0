"""What the local store does with folders of artifacts: find them, read their manifests, move them out of the way."""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from genre_tasks.errors import ArtifactCorruptError
from genre_tasks.temporary_names import describe_owner
from storage.manifest import MANIFEST, Manifest, NewerSchemaError, parse_manifest

TEMPORARY_PREFIX = ".tmp-"
TRASH_PREFIX = ".trash-"


def find_artifact_folders(base: Path) -> Iterator[Path]:
    """Finds folders that hold a manifest, whether it is sound or not.

    Args:
        base: where to search; it need not exist.

    Yields:
        The folders in the order of their paths. Hidden folders, which are temporary, are left out.
    """
    for folder, names, files in os.walk(base):
        # In place, which is how a walk is told where to go on and in which order.
        names[:] = sorted(n for n in names if not n.startswith("."))
        if MANIFEST in files:
            # No artifact lies inside another: what is below is payload.
            names.clear()
            yield Path(folder)


def load_manifest(folder: Path) -> Manifest:
    """Reads the manifest of a folder.

    Args:
        folder: an artifact's folder.

    Returns:
        The manifest.

    Raises:
        OSError: there is none, or it cannot be read.
        ArtifactCorruptError: it cannot be trusted.
    """
    return parse_manifest((folder / MANIFEST).read_bytes(), folder / MANIFEST)


def find_sound_manifest(folder: Path) -> Manifest | None:
    """Reads the manifest of a folder that may be damaged or missing.

    Args:
        folder: an artifact's folder.

    Returns:
        The manifest, or ``None`` where there is none that can be trusted.

    Raises:
        NewerSchemaError: a newer version of the project wrote it.
    """
    try:
        return load_manifest(folder)
    # It is a subclass of the error below, but its artifact is sound: it must never be replaced.
    except NewerSchemaError:
        raise
    except (ArtifactCorruptError, FileNotFoundError, NotADirectoryError):
        return None


def move_to_trash(folder: Path) -> Path | None:
    """Renames a folder to a hidden name beside it, so that nobody meets it half removed.

    Args:
        folder: an artifact's folder.

    Returns:
        The new path, or ``None`` where the folder was not there.

    Raises:
        OSError: the folder cannot be renamed.
    """
    trash = folder.parent / f"{TRASH_PREFIX}{describe_owner()}-{uuid.uuid4().hex}"
    try:
        folder.rename(trash)
    except FileNotFoundError:
        return None
    return trash


def last_modified(folder: Path) -> float:
    """Finds when anything in a folder was last modified.

    Args:
        folder: the folder; other processes may be removing it.

    Returns:
        Seconds since the epoch; now, where everything is gone.
    """
    times = []
    # Not by pathlib, which raises where a folder disappears while it is listed.
    below = [Path(base) / name for base, names, files in os.walk(folder) for name in (*names, *files)]
    for path in (folder, *below):
        with suppress(FileNotFoundError):
            # The link itself and not its target, which may lie anywhere.
            times.append(path.lstat().st_mtime)
    return max(times, default=time.time())
