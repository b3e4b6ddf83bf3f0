"""What the local store does with folders of artifacts: find them, read their manifests, move them out of the way."""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from genre_tasks.errors import ArtifactCorruptError, GenreError
from genre_tasks.temporary_names import describe_owner
from storage.io_errors import as_genre_error
from storage.manifest import MANIFEST, Manifest, NewerSchemaError, parse_manifest

TEMPORARY_PREFIX = ".tmp-"
TRASH_PREFIX = ".trash-"
# Of the file system and not of the store, where this is a whole disk: root alone may look into it.
_SYSTEM_FOLDER = "lost+found"


def find_artifact_folders(base: Path) -> Iterator[Path]:
    """Finds folders that hold a manifest, whether it is sound or not.

    Args:
        base: where to search; it need not exist.

    Yields:
        The folders in the order of their paths. Hidden folders, which are temporary, are left out.

    Raises:
        InputError: a folder must not be listed, and might hold artifacts.
        TransientIOError: the file system does not answer.
    """
    for folder, error in walk_artifact_folders(base):
        if error is not None:
            raise error
        yield folder


def walk_artifact_folders(base: Path) -> Iterator[tuple[Path, GenreError | None]]:
    """Finds folders that hold a manifest, and goes on past folders that cannot be listed.

    Args:
        base: where to search; it need not exist.

    Yields:
        (a folder with a manifest, ``None``) as :func:`find_artifact_folders` finds them, and (a folder that cannot be
        listed, its error).
    """
    faults: list[OSError] = []
    # The walk leaves out what it cannot list, and with it every artifact below.
    for folder, names, files in os.walk(base, onerror=faults.append):
        yield from _take_faults(faults)
        # In place, which is how a walk is told where to go on and in which order.
        names[:] = sorted(n for n in names if not n.startswith(".") and n != _SYSTEM_FOLDER)
        if MANIFEST in files:
            # No artifact lies inside another: what is below is payload.
            names.clear()
            yield Path(folder), None
    yield from _take_faults(faults)


def _take_faults(faults: list[OSError]) -> Iterator[tuple[Path, GenreError]]:
    for error in faults:
        # Another process may have removed a folder since its name was read; the base need not exist at all.
        if not isinstance(error, FileNotFoundError | NotADirectoryError):
            folder = Path(error.filename)
            yield folder, as_genre_error(error, folder)
    faults.clear()


def find_hidden(base: Path) -> Iterator[Path]:
    """Finds hidden files and folders, which may be what killed processes left behind.

    Payload is not looked into, as all of it is written before its folder has its name.

    Args:
        base: where to search; it need not exist.

    Yields:
        The paths. What is in a temporary folder is no part of them; it may be removed at once.
    """
    for folder, names, files in os.walk(base):
        hidden = [name for name in (*names, *files) if name.startswith(".")]
        # Before they are yielded: the walk would enter folders that are going away.
        names[:] = [] if MANIFEST in files else [n for n in names if not n.startswith((TEMPORARY_PREFIX, TRASH_PREFIX))]
        for name in hidden:
            yield Path(folder) / name


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
