"""Files that appear whole or not at all, for everything that is written outside of the store."""

from __future__ import annotations

import errno
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from genre_tasks.errors import ConfigError, GenreError
from genre_tasks.temporary_names import describe_owner, remove_abandoned, remove_path

# Writing to a file that is open names no file in its error.
_ERRORS_OF_OPEN_FILES = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Gives a temporary path beside ``path``; when the block ends, the file written there replaces ``path``.

    After an error the old file is still there, the temporary one is gone, and the error names ``path``. Two
    processes may write the same path.

    Args:
        path: the file to replace; its folder exists.

    Yields:
        The path to write to.

    Example::

        with atomic_path(Path("report.html")) as part:
            part.write_text(html)
    """
    # A process that was killed in the block could not tidy up.
    remove_abandoned(path.parent)
    # The owner keeps two writers apart; the suffix stays, since libraries choose the format by it.
    part = path.with_name(f".{path.stem}.{describe_owner()}.part{path.suffix}")
    try:
        yield part
        part.replace(path)
    except (OSError, GenreError) as error:
        _name_target(error, part, path)
        raise
    finally:
        # A disk that may only be read refuses this too, which would hide the first error.
        with suppress(OSError):
            part.unlink(missing_ok=True)


def _name_target(error: OSError | GenreError, part: Path, path: Path) -> None:
    """Makes an error of the temporary file name the file that was asked for."""
    if isinstance(error, GenreError):
        if error.file == str(part):
            error.file = str(path)
    elif str(part) in (str(error.filename), str(error.filename2)) or (
        error.filename is None and error.errno in _ERRORS_OF_OPEN_FILES
    ):
        # A copy that fails names its source as well, which is not to blame.
        error.filename, error.filename2 = str(path), None


def write_atomically(path: Path, data: bytes) -> None:
    """Writes a file that must survive a loss of power, such as a checkpoint that a training resumes from.

    Args:
        path: the file to write or replace; its folder is made where it is missing.
        data: all of its bytes.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part, part.open("wb") as file:
        file.write(data)
        file.flush()
        # A rename can reach the disk before the data does: without this, a crash could leave an empty file.
        os.fsync(file.fileno())


def holds_files(folder: Path) -> bool:
    """Says whether there is a folder with anything in it.

    Args:
        folder: that may be missing.

    >>> holds_files(Path("no such folder"))
    False
    """
    return folder.exists() and any(folder.iterdir())


def replace_folder(folder: Path, complete: Path, held_files: bool) -> None:
    """Puts a complete folder in the place of another one, which goes only when the new one is there.

    Args:
        folder: the place; there may be nothing, an empty folder or a full one.
        complete: the new folder, on the same file system.
        held_files: whether the place was full when it was found that it may be replaced.

    Raises:
        ConfigError: the place was empty then and is full now; what is there stays.
        OSError: it cannot be renamed; what was at the place is there again.
    """
    is_full = holds_files(folder)
    # Hours may lie between: another command's result, or notes of the user, may be the only copy.
    if is_full and not held_files:
        raise ConfigError("the folder was filled meanwhile", remedy="Run again with another folder.", file=folder)
    if not is_full:
        # A rename takes the place of an empty folder.
        complete.rename(folder)
        return
    old = folder.with_name(f".{folder.name}-{describe_owner()}-{uuid.uuid4().hex[:8]}")
    folder.rename(old)
    try:
        complete.rename(folder)
    except BaseException:
        old.rename(folder)
        raise
    remove_path(old)
