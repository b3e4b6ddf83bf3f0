"""Folders of records beside the artifacts: runs and datasets, their reports, and what was measured of them later."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Protocol

from genre_tasks.errors import ConfigError
from storage.io_errors import as_genre_error


class RecordFolders(Protocol):
    """Folders such as ``runs/5f41c0de9a1b``, whose files are read and written on this machine.

    Example::

        folder = store.records.pull("runs/5f41c0de9a1b")
        (folder / "run.json").write_text(text)
        store.records.push("runs/5f41c0de9a1b")
    """

    def pull(self, name: str) -> Path:
        """Brings a folder with its files to this machine.

        Args:
            name: the folder's name, with "/" between its parts.

        Returns:
            The folder on this machine. It need not exist where the store has none of this name.

        Raises:
            ConfigError: the name leads out of the store.
            TransientIOError: the store does not answer.
        """
        ...

    def push(self, name: str) -> None:
        """Makes what was written into a pulled folder visible to everyone who uses the store.

        Args:
            name: the folder's name.

        Raises:
            ConfigError: the name leads out of the store.
            TransientIOError: the store does not answer.
        """
        ...

    def remove(self, name: str) -> None:
        """Removes a folder; nothing happens where there is none.

        Args:
            name: the folder's name.

        Raises:
            ConfigError: the name leads out of the store.
            InputError: the store cannot be written.
            TransientIOError: the store does not answer.
        """
        ...

    def find(self, parent: str, file: str, start: str = "") -> list[Path]:
        """Finds a file of many folders, such as every run's ``run.json``.

        Args:
            parent: the folder above them, such as ``runs``.
            file: the file's name.
            start: how the names of the folders begin.

        Returns:
            The files on this machine, the one that was written first at the front.

        Raises:
            InputError: the folder above them must not be listed.
            TransientIOError: the store does not answer.
        """
        ...


class LocalRecordFolders:
    """Record folders of a store that is itself a folder of this machine.

    Args:
        root: the store's folder.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    def pull(self, name: str) -> Path:
        """Gives the folder where it is: see :meth:`RecordFolders.pull`."""
        return self._root.joinpath(*split_record_name(name))

    def push(self, name: str) -> None:
        """Does nothing, as files are written in place."""
        split_record_name(name)

    def remove(self, name: str) -> None:
        """Removes a folder: see :meth:`RecordFolders.remove`."""
        folder = self.pull(name)
        try:
            shutil.rmtree(folder)
        except FileNotFoundError:
            return
        except OSError as error:
            raise as_genre_error(error, folder) from error

    def find(self, parent: str, file: str, start: str = "") -> list[Path]:
        """Finds a file of many folders: see :meth:`RecordFolders.find`."""
        folder = self._root.joinpath(*split_record_name(parent))
        if not can_start_name(start):
            return []
        try:
            with os.scandir(folder) as entries:
                # Only folders that fit are looked into: a dataset asks for one of its thousand runs after the other.
                names = sorted(entry.name for entry in entries if entry.name.startswith(start))
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            # Records that are not known of must not count as removed: what they refer to would be garbage.
            raise as_genre_error(error, folder) from error
        times_s = {path: _modified_s(path) for path in (folder / name / file for name in names)}
        found = {path: time_s for path, time_s in times_s.items() if time_s is not None}
        return sorted(found, key=found.__getitem__)


def can_start_name(start: str) -> bool:
    """Says whether a folder's name may begin so; pathlib and buckets raise where a path is given in its place.

    Args:
        start: what a user wrote.

    >>> can_start_name("5f41"), can_start_name("/data/runs/5f41")
    (True, False)
    """
    return "/" not in start and "\0" not in start


def _modified_s(path: Path) -> float | None:
    try:
        return path.stat().st_mtime
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError:
        # Whoever reads the record is told why it cannot be read.
        return 0.0


def split_record_name(name: str) -> tuple[str, ...]:
    """Checks the name of a record folder, which may come from a record that somebody edited.

    Args:
        name: such as ``runs/5f41c0de9a1b``.

    Returns:
        Its parts.

    Raises:
        ConfigError: a part is empty or hidden, or leads upwards.

    >>> split_record_name("runs/5f41c0de9a1b")
    ('runs', '5f41c0de9a1b')
    """
    parts = tuple(name.split("/"))
    if any(not part or part.startswith(".") or "\\" in part or "\0" in part for part in parts):
        raise ConfigError(f"{name!r} cannot be the name of a record's folder", remedy="Give a name such as runs/5f41.")
    return parts
