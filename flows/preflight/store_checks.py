"""Checks of the store's folder: it is a folder of this machine, and files can be written and deleted there."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from genre_tasks.errors import ConfigError, InputError, ResourceError
from storage.io_errors import as_genre_error
from storage.local import LocalStore
from storage.opening import open_store

MIN_FREE_MIB = 100
"""A run is refused with less free space: the first stages alone would fill it."""

_REMEDY = "Give by --store a folder that this user can write to."
_PROBE_BYTES = 4096


def check_store(store: str, parts: tuple[str, ...] = ()) -> Path | None:
    """Checks that artifacts can be written to a store, and leaves no trace of that.

    Args:
        store: folder (or URI) of the store; it need not exist yet.
        parts: names of the folders in it that artifacts will go to, such as dataset and log.

    Returns:
        The store's folder; ``None`` for a store that is no folder of this machine.

    Raises:
        ConfigError: the URI is of no known kind.
        InputError: a part of its path is a file, or it cannot be written to.
        ResourceError: there is almost no free space.
        TransientIOError: a remote store does not answer.
    """
    # A flow's parameters may hold anything; a character that ends a C string would fail in every call.
    if not isinstance(store, str) or "\0" in store:
        raise ConfigError(f"the store is no path: {store!r}", remedy=_REMEDY)
    opened = open_store(store)
    if not isinstance(opened, LocalStore):
        opened.check_writable()
        return None
    root = opened.root
    # Reports of runs go into the store as well, beside the artifacts.
    for folder in (root.joinpath(*parts), root / "runs"):
        _probe(folder)
    free_mib = free_space_mib(root)
    if free_mib < MIN_FREE_MIB:
        raise ResourceError(
            f"the disk of the store has {free_mib:.0f} MiB of free space, at least {MIN_FREE_MIB} are needed",
            remedy="Free space there, or choose another place with --store.",
            file=root,
        )
    return root


def free_space_mib(folder: Path) -> float:
    """Finds the free space of the disk that a folder is on, or will be on.

    Args:
        folder: it need not exist yet.

    Returns:
        What this user may still write, MiB.

    Raises:
        OSError: the disk does not answer.
    """
    status = os.statvfs(_nearest_existing(folder))
    return status.f_bavail * status.f_frsize / 2**20


def _probe(folder: Path) -> None:
    """Writes and deletes a small file in the folder, or in the nearest one above it that exists."""
    try:
        existing = _nearest_existing(folder)
        if not existing.is_dir():
            raise InputError("a part of the store's path is no folder", remedy=_REMEDY, file=existing)
        # Permissions alone do not tell: a disk may be full or mounted read-only, and root may do anything.
        with tempfile.TemporaryFile(dir=existing, prefix=".tmp-probe-") as file:
            file.write(b"\0" * _PROBE_BYTES)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        # The temporary file's name says nothing to the user.
        error.filename = None
        raise as_genre_error(error, folder) from error


def _nearest_existing(folder: Path) -> Path:
    """The folder, or the nearest above it that exists; a link to nowhere exists, too, as no folder can replace it."""
    for path in (folder, *folder.parents):
        try:
            path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            continue
        # Other errors go to the caller: a name that is too long, or a folder that may not be entered.
        return path
    return folder
