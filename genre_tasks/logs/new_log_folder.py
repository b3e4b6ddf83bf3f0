"""Folders of logs that appear complete or not at all."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from genre_tasks.errors import InputError, ResourceError
from genre_tasks.temporary_names import describe_owner, remove_abandoned


@contextmanager
def new_log_folder(folder: Path, log: str) -> Iterator[Path]:
    """Gives a temporary folder to write a log into, which becomes the folder when the block ends.

    Args:
        folder: to write; it does not exist yet, or is empty.
        log: URI of the log, for errors.

    Yields:
        Path: the folder to write into.

    Raises:
        InputError: the folder holds something already.
        ResourceError: the disk is full or not writable.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        remedy = "Give a folder that does not exist yet, or remove this one first."
        raise InputError("the folder to write holds something already", remedy=remedy, file=folder, log=log)
    # Beside the target, since only a rename within one file system is atomic.
    remove_abandoned(folder.parent)
    partial = folder.parent / f".{folder.name}.{describe_owner()}-{uuid.uuid4().hex[:8]}.partial"
    try:
        partial.mkdir(parents=True)
        yield partial
        # An empty folder would stop the rename on some systems.
        if folder.exists():
            folder.rmdir()
        partial.replace(folder)
    except OSError as error:
        problem = f"the log could not be written ({error})"
        raise ResourceError(problem, remedy="Free space, or give another folder.", file=folder, log=log) from error
    finally:
        # After a success there is nothing left to remove.
        shutil.rmtree(partial, ignore_errors=True)
