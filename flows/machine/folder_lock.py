"""The exclusive right to write into a folder that one process at a time may train in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from genre_tasks.errors import InputError

LOCK_FILE = ".lock"


@contextmanager
def hold_training_folder(folder: Path) -> Iterator[None]:
    """Keeps other processes from training in a folder while the block runs.

    Two trainings of one folder would write each other's checkpoints, and the slower one would undo the faster one's
    steps. The system frees the lock when its process ends, by whatever cause.

    Args:
        folder: of the training; made where it is missing.

    Yields:
        Nothing.

    Raises:
        InputError: another process trains there.
        OSError: the folder cannot be written.
    """
    from filelock import FileLock, Timeout

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / LOCK_FILE
    lock = FileLock(path)
    try:
        # Not waited for: a training takes hours, and a second one is more often a mistake than a plan.
        lock.acquire(timeout=0)
    except Timeout as error:
        remedy = "Wait until it has ended, then run the command again; or choose another folder."
        raise InputError("another process trains in this folder", remedy=remedy, file=folder) from error
    try:
        yield
    finally:
        # While the lock is held: whoever opened the file meanwhile sees that its name is gone, and tries again.
        path.unlink(missing_ok=True)
        lock.release()
