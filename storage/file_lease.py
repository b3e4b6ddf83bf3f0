"""The exclusive right to compute an artifact of a local store: a lock of the system on a file, freed at any death."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from genre_tasks.progress import Progress
from storage.address import Address
from storage.files import make_folders
from storage.io_errors import as_genre_error

LEASES_FOLDER = ".leases"
_POLL_S = 0.2


@contextmanager
def hold_file_lease(root: Path, address: Address, progress: Progress) -> Iterator[None]:
    """Waits until nobody else computes an artifact, and keeps others from it while the block runs.

    The system frees the lock when its process ends, by whatever cause. It needs no clock and no heartbeat.

    Args:
        root: the store's folder.
        address: of the artifact.
        progress: called while another process holds the lease.

    Yields:
        Nothing.

    Raises:
        InputError: the folder cannot be written.
        ResourceError: the disk is full.
    """
    from filelock import FileLock, Timeout

    # Flat and by key: the key says it all, and a folder a stage would be left behind by every artifact.
    path = root / LEASES_FOLDER / f"{address.key}.lock"
    try:
        make_folders(path.parent)
        lock = FileLock(path)
        while True:
            try:
                lock.acquire(timeout=_POLL_S, poll_interval=_POLL_S)
                break
            except Timeout:
                progress(0, 1, "another process computes this artifact")
    except OSError as error:
        raise as_genre_error(error, path, address) from error
    try:
        yield
    finally:
        # While the lock is held: whoever opened the file meanwhile sees that its name is gone, and tries again.
        path.unlink(missing_ok=True)
        lock.release()
