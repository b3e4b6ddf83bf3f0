"""Names of temporary files and folders that say which process owns them, so that those of killed processes can go.

A name alone must do: a killed process cannot tidy up, and the age of a file does not tell whether it is still written.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import shutil
import socket
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from genre_tasks.process_start import read_start_ticks

_OWNER = re.compile(r"(?P<machine>[0-9a-f]{8})-(?P<process>\d+)-(?P<started>\d+)")
_FOLDER_PREFIX = "genre-"


def describe_owner() -> str:
    """Names this process so that another one can tell later whether it still runs.

    Returns:
        Machine, process and its start, such as ``5f41c0de-4711-176408``; good for file names.

    >>> describe_owner() == describe_owner()
    True
    """
    return f"{_machine()}-{os.getpid()}-{read_start_ticks(os.getpid())}"


def is_abandoned(path: Path) -> bool:
    """Tells whether the process that a temporary file or folder belongs to has ended.

    Args:
        path: its name has :func:`describe_owner` in it.

    Returns:
        True only if that is certain: the process was one of this user on this machine, and it is gone.

    >>> is_abandoned(Path("report.html"))
    False
    """
    owner = _OWNER.search(path.name)
    # A shared folder has files of other machines, whose processes cannot be asked for.
    if owner is None or owner["machine"] != _machine():
        return False
    with suppress(OSError):
        # A system may hide the processes of other users, which then seem to be gone.
        if path.lstat().st_uid == os.getuid():
            return not is_in_use(path)
    return False


def is_in_use(path: Path) -> bool:
    """Tells whether the process that a temporary file or folder belongs to is seen to run.

    Args:
        path: its name has :func:`describe_owner` in it.

    Returns:
        False also where it cannot be told: of another machine, or where the system hides the process.

    >>> is_in_use(Path(f".tmp-{describe_owner()}")), is_in_use(Path("report.html"))
    (True, False)
    """
    owner = _OWNER.search(path.name)
    if owner is None or owner["machine"] != _machine():
        return False
    # Numbers of processes are used again, so the start has to be the same too.
    return read_start_ticks(int(owner["process"])) == int(owner["started"])


def remove_abandoned(folder: Path) -> int:
    """Removes what killed processes left in a folder.

    Args:
        folder: whose files and folders are removed, not those in folders below; it may be missing.

    Returns:
        How many were removed.
    """
    removed = 0
    # Another process may tidy up at the same moment.
    with suppress(OSError):
        for path in folder.iterdir():
            if is_abandoned(path):
                remove_path(path)
                removed += 1
    return removed


def remove_path(path: Path) -> None:
    """Removes a file or a folder with all that is in it; what is gone already is no error."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """Makes a folder for the time of a block; folders of killed processes beside it are removed first.

    Args:
        parent: where to make it; by default the system's folder for temporary files.

    Yields:
        The new folder.
    """
    where = Path(tempfile.gettempdir()) if parent is None else parent
    remove_abandoned(where)
    folder = where / f"{_FOLDER_PREFIX}{describe_owner()}-{uuid.uuid4().hex[:8]}"
    folder.mkdir(mode=0o700)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@functools.cache
def _machine() -> str:
    """Eight hex digits, the same for all processes that see the same numbers of processes."""
    # Containers on one machine may share its name and count their processes apart.
    known = [socket.gethostname()]
    for path in (Path("/proc/sys/kernel/random/boot_id"), Path("/proc/self/ns/pid")):
        with suppress(OSError):
            known.append(str(path.readlink()) if path.is_symlink() else path.read_text())
    return hashlib.sha256("\n".join(known).encode()).hexdigest()[:8]
