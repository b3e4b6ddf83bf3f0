"""The lock of a file in a state folder."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from genre_tasks.errors import ConfigError


def lock_file(stream: IO[str], path: Path) -> None:
    """Waits until no other process has locked a file; closing it frees the lock.

    Args:
        stream: the file, open for writing.
        path: where it is, for the error.

    Raises:
        ConfigError: the file system of the folder has no locks, as NFS without a lock service.
    """
    import fcntl

    try:
        fcntl.flock(stream, fcntl.LOCK_EX)
    except OSError as error:
        # Without locks, two starts at once would each start all services, and the record would know those of one.
        problem = f"files of the state folder cannot be locked ({error.strerror})"
        raise ConfigError(problem, remedy="Name a folder on a local disk with --folder.", file=path.parent) from error
