"""The folder for what a command keeps between runs besides its results: Prefect's database, and logs of faults."""

from __future__ import annotations

import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

from genre_tasks.errors import ConfigError

_WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH


def find_state_folder() -> Path:
    """Finds the first folder for state that this user may write to, and makes it.

    The user's state folder (``$XDG_STATE_HOME`` or ``~/.local/state``) comes first. It is a local disk more often than
    the store is, and it does not litter the working folder, which may be read-only. Where it cannot be written, as
    for a service's user without a home, a folder of the user among the temporary files takes its place.

    Returns:
        The folder, absolute.

    Raises:
        OSError: neither can be made.
        ConfigError: the folder among the temporary files belongs to another user, or others may write to it.
    """
    for folder in _candidates():
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK | os.X_OK):
            return folder
    folder = Path(tempfile.gettempdir()).absolute() / f"genre-{os.getuid()}"
    # The folder of temporary files is everyone's: nobody else is to read a log's name in a database.
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    # What others could have put there would be read as settings, and lines of it are given to shells.
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & _WRITABLE_BY_OTHERS:
        problem = f"{folder} belongs to another user, or others may write to it"
        raise ConfigError(problem, remedy="Set XDG_STATE_HOME to a folder of yours.", file=folder)
    return folder


def _candidates() -> list[Path]:
    stated = os.environ.get("XDG_STATE_HOME", "")
    folders = [Path(stated) / "genre"] if stated else []
    # A user without an entry in the system's list of users has no home.
    with suppress(RuntimeError):
        folders.append(Path.home() / ".local" / "state" / "genre")
    # The standard asks for absolute paths; a relative one would depend on the working folder.
    return [folder for folder in folders if folder.is_absolute()]
