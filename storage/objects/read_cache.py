"""What this machine has read from a bucket: a folder with a bound, from which the least recently used goes first."""

from __future__ import annotations

import os
import shutil
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from genre_tasks.errors import ConfigError
from genre_tasks.temporary_names import describe_owner, remove_abandoned
from storage.address import Address

LIMIT_VARIABLE = "GENRE_CACHE_GB"
"""The environment variable for the bound, in gigabytes (10⁹ bytes)."""
_LIMIT_GB = 20.0
# What was used so recently may be in use by a process that has not opened all of its files yet.
_IN_USE_S = 900.0
_ROOM = 0.9
_CHECK_EVERY = 0.02
_USED = ".used"


class ReadCache:
    """Artifacts of one store, each in a folder named by its address and the digest of its payload.

    Several processes share it: a folder's files appear complete or not at all.

    Args:
        folder: of this store's artifacts and temporary files.
        limit_bytes: how large it may become, apart from what is in use.
    """

    def __init__(self, folder: Path, limit_bytes: int) -> None:
        self.folder = folder
        self._limit_bytes = limit_bytes
        # The first write of a process looks, as others may have filled it.
        self._unchecked_bytes = limit_bytes

    def find_folder(self, address: Address, payload_digest: str) -> Path:
        """Names the folder of an artifact's files.

        Args:
            address: of the artifact.
            payload_digest: of its files.

        Returns:
            The folder, which need not exist.
        """
        return self.folder / "artifacts" / address.relative_path / payload_digest[:12]

    @contextmanager
    def temporary(self) -> Iterator[Path]:
        """Makes a folder to write into, which is removed at the end unless it was renamed.

        Yields:
            The folder.

        Raises:
            OSError: it cannot be made.
        """
        path = self.folder / f"tmp-{describe_owner()}-{uuid.uuid4().hex}"
        path.mkdir(parents=True)
        try:
            yield path
        finally:
            shutil.rmtree(path, ignore_errors=True)

    def keep(self, temporary: Path, target: Path) -> None:
        """Moves a complete folder into the cache, so that it need not be read from the bucket.

        Args:
            temporary: made by :meth:`temporary`.
            target: named by :meth:`find_folder`.

        Raises:
            OSError: it cannot be moved.
        """
        size = sum(path.stat().st_size for path in temporary.rglob("*") if path.is_file())
        # Before the move: without it a process that dies now would leave a folder that never goes.
        self.mark_used(temporary)
        target.parent.mkdir(parents=True, exist_ok=True)
        # A process that was faster has the same bytes there.
        with suppress(OSError):
            temporary.rename(target)
        self.mark_used(target)
        self.make_room(size)

    def mark_used(self, folder: Path) -> None:
        """Notes that a folder is in use.

        Args:
            folder: named by :meth:`find_folder`; it may have been removed meanwhile.
        """
        with suppress(FileNotFoundError):
            (folder / _USED).touch()

    def make_room(self, added_bytes: int) -> None:
        """Removes what was not used for longest once the bound is exceeded; what is in use stays.

        Args:
            added_bytes: what was written now.
        """
        self._unchecked_bytes += added_bytes
        # To measure all folders takes a while: not after every artifact.
        if self._unchecked_bytes < _CHECK_EVERY * self._limit_bytes:
            return
        self._unchecked_bytes = 0
        entries = sorted(self._measure())
        total = sum(size for _, size, _ in entries)
        if total <= self._limit_bytes:
            return
        for used, size, folder in entries:
            if total <= _ROOM * self._limit_bytes or time.time() - used < _IN_USE_S:
                return
            trash = self.folder / f"tmp-{describe_owner()}-{uuid.uuid4().hex}"
            # Another process may do the same.
            with suppress(OSError):
                # Somebody may have begun to use it since it was measured.
                if (folder / _USED).stat().st_mtime > used:
                    continue
                folder.rename(trash)
                shutil.rmtree(trash, ignore_errors=True)
            total -= size

    def clean_temporaries(self) -> int:
        """Removes what killed processes of this machine left behind.

        Returns:
            How many folders were removed.
        """
        return remove_abandoned(self.folder)

    def _measure(self) -> Iterator[tuple[float, int, Path]]:
        for folder, _, files in os.walk(self.folder / "artifacts"):
            if _USED not in files:
                continue
            path = Path(folder)
            with suppress(OSError):
                size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
                yield (path / _USED).stat().st_mtime, size, path


def read_limit_bytes() -> int:
    """Reads the bound of the cache from the environment.

    Returns:
        Bytes.

    Raises:
        ConfigError: ``GENRE_CACHE_GB`` is no number above 0.
    """
    text = os.environ.get(LIMIT_VARIABLE)
    try:
        limit = _LIMIT_GB if not text else float(text)
    except ValueError:
        limit = 0.0
    if not 0 < limit < float("inf"):
        raise ConfigError(f"{LIMIT_VARIABLE} is {text!r}", remedy="Give a number of gigabytes, such as 20.")
    return round(limit * 1e9)
