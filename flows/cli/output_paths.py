"""Output paths, checked before any work: a path that cannot be written is to be known at once."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection
from pathlib import Path

from genre_tasks.errors import InputError

_MAX_NAME_BYTES = 255
"""The longest name that the usual file systems take."""
_TEMPORARY_NAME_BYTES = 40
"""How much longer the name is under which a file is written before it is complete."""


def check_output_file(path: Path, option: str, suffixes: Collection[str] = ()) -> None:
    """Checks that a file can be written; folders that are missing are made later.

    Args:
        path: the file; an existing one will be replaced.
        option: the option that names it, for the error.
        suffixes: the endings that are allowed, in lower case, such as ``.png``; in the path their case is free. Any if
            empty.

    Raises:
        InputError: the ending is another one, the path is a folder or lies under a file, or it may not be written.
    """
    known = " or ".join(f"x{suffix}" for suffix in suffixes)
    is_there = _exists(path, option)
    if is_there and path.is_dir():
        example = f", such as {path / f'x{next(iter(suffixes))}'}" if suffixes else ""
        raise InputError(f"{option} is a folder", remedy=f"Name a file in it{example}.", file=path)
    if suffixes and path.suffix.lower() not in suffixes:
        found = f"ends with '{path.suffix}'" if path.suffix else "has no ending"
        raise InputError(f"{option} {found}, so its format is unknown", remedy=f"Give {option} {known}.", file=path)
    if is_there:
        if not path.is_file():
            raise InputError(f"{option} is no regular file", remedy="Name another file.", file=path)
        if not os.access(path, os.W_OK):
            raise InputError(f"{option} is write-protected", remedy="Name another file, or unlock it.", file=path)
    if len(os.fsencode(path.name)) + _TEMPORARY_NAME_BYTES > _MAX_NAME_BYTES:
        raise InputError(f"the name of {option} is too long", remedy="Give a shorter one.", file=path)
    _check_can_create(path.parent, option)


def check_output_folder(path: Path, option: str, files: Collection[str] = ()) -> None:
    """Checks that files can be written into a folder; it is made later if it is missing.

    Args:
        path: the folder.
        option: the option that names it, for the error.
        files: names of the files that will be written there.

    Raises:
        InputError: the path is a file or lies under one, or it may not be written.
    """
    if _exists(path, option) and not path.is_dir():
        raise InputError(f"{option} is a file", remedy="Name a folder.", file=path)
    _check_can_create(path, option)
    for name in files:
        check_output_file(path / name, f"{name} in {option}")


def check_new_folder(path: Path, option: str) -> None:
    """Checks that a folder can be written as a whole: under another name at first, which it loses when it is complete.

    Args:
        path: the folder.
        option: the option that names it, for the error.

    Raises:
        InputError: the path has no name of its own, such as ``.``, it is a link or where a file system is mounted, or
            as :func:`check_output_folder` raises it.
    """
    if path.name in ("", ".."):
        raise InputError(f"{option} names no folder of its own", remedy="Name a new folder.", file=path)
    # A folder that was completed under another name can take the place of neither.
    if path.is_symlink() or os.path.ismount(path):
        found = "a link" if path.is_symlink() else "where a file system is mounted"
        remedy = f"Name a new folder in the one that it leads to, such as {path / 'out'}."
        raise InputError(f"{option} is {found}, which cannot be replaced as a whole", remedy=remedy, file=path)
    check_output_folder(path, option)
    _check_can_create(path.parent, option)


def _exists(path: Path, option: str) -> bool:
    try:
        is_there = path.exists()
    except OSError as error:
        # A name that is too long, or a folder on the way that may not be entered.
        problem = f"{option} cannot be used ({error.strerror})"
        raise InputError(problem, remedy="Name another place.", file=path) from error
    if not is_there and path.is_symlink():
        raise InputError(f"{option} is a link to nothing", remedy="Remove the link, or name another file.", file=path)
    return is_there


def _check_can_create(folder: Path, option: str) -> None:
    """Checks that the folder, or the nearest one above it that exists, takes a file."""
    nearest = next((place for place in (folder, *folder.parents) if _exists(place, option)), Path())
    if not nearest.is_dir():
        raise InputError(f"{option} lies under a file", remedy="Name a folder that exists, or a new one.", file=nearest)
    try:
        # Tried, and not asked for by the permissions: those say nothing of a read-only or full file system.
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        problem = f"{option} cannot be written ({error.strerror})"
        raise InputError(
            problem, remedy="Name a folder in which this user may write, and with space left.", file=nearest
        ) from error
