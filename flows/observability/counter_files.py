"""Counts of many short-lived processes as files of one folder, of which none is lost and none counts twice.

Every process replaces its file as its counts change, so that a kill loses nothing that was counted before. Files of
processes that have ended are folded into one file of totals. It names what it has taken in, and whatever it names
counts no more: a kill between the two steps of folding doubles nothing.
"""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from genre_tasks.temporary_names import describe_owner, is_abandoned

if TYPE_CHECKING:
    from filelock import FileLock

TOTALS = "totals.json"
"""The file of what was folded."""

MAX_FILES = 256
"""A process that starts counting folds the others' files first if there are more than so many."""

Sample = tuple[str, ...]
"""Name of a metric, followed by the values of its labels."""

# Below the folder that the user names: whoever tidies up temporary files there must not take these for some.
_FOLDER = "counts"
_PATTERN = "process-*.json"
# Files of another boot, or of another container: nobody can ask for their processes.
_FOREIGN_AGE_S = 86400.0


@dataclass(frozen=True)
class Counts:
    """Counts of one process or of many.

    Attributes:
        totals: what only grows, by sample.
        running: what goes up and down, by sample.
    """

    totals: dict[Sample, float] = field(default_factory=dict)
    running: dict[Sample, float] = field(default_factory=dict)


class CounterFolder:
    """The folder of the files.

    Args:
        folder: as the user names it; it is made when something is counted.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / _FOLDER

    def name_file(self) -> Path:
        """Names a new file for the counts of this process.

        Returns:
            The path; the file is not there yet.
        """
        return self._folder / f"process-{describe_owner()}-{uuid.uuid4().hex[:8]}.json"

    def write(self, path: Path, counts: Counts) -> None:
        """Replaces a process's file.

        Args:
            path: from :meth:`name_file`.
            counts: everything that the process has counted under this name.

        Raises:
            OSError: the folder cannot be written.
        """
        self._replace(path, {"totals": _as_rows(counts.totals), "running": _as_rows(counts.running)})

    def read(self) -> Counts:
        """Adds up all files, and folds those of processes that have ended.

        Returns:
            Totals of all processes, and what runs in those that live on this machine.

        Raises:
            OSError: the folder cannot be written.
        """
        # Within the lock: what another process folds after the totals were read would be in neither.
        with self._lock():
            totals, live = self._fold()
            sums = Counts(totals)
            for path in live:
                counts = _read_counts(path)
                add_counts(sums.totals, counts.totals)
                # Another machine's process may be long gone.
                if not _is_foreign(path):
                    add_counts(sums.running, counts.running)
        return sums

    def fold_if_many(self) -> None:
        """Folds what ended processes left, if there are many files and no one reads them.

        Raises:
            OSError: the folder cannot be written.
        """
        if sum(1 for _ in self._folder.glob(_PATTERN)) > MAX_FILES:
            with self._lock():
                self._fold()

    def _lock(self) -> FileLock:
        """The lock that whoever folds holds."""
        from filelock import FileLock

        self._folder.mkdir(parents=True, exist_ok=True)
        return FileLock(self._folder / ".lock")

    def _fold(self) -> tuple[dict[Sample, float], list[Path]]:
        """The totals of the processes that have ended, and the files of the others; the caller holds the lock."""
        totals, folded = self._read_totals()
        live = []
        ended = []
        for path in sorted(self._folder.glob(_PATTERN)):
            if path.name in folded:
                # Its folding was interrupted after the totals had been written.
                path.unlink(missing_ok=True)
            elif is_abandoned(path) or _is_old_foreign(path):
                ended.append(path)
            else:
                live.append(path)
        if ended:
            for path in ended:
                add_counts(totals, _read_counts(path).totals)
            names = [path.name for path in ended]
            self._replace(self._folder / TOTALS, {"totals": _as_rows(totals), "folded": names})
            for path in ended:
                path.unlink(missing_ok=True)
            self._remove_parts()
        return totals, live

    def _read_totals(self) -> tuple[dict[Sample, float], set[str]]:
        values = _read_json(self._folder / TOTALS)
        return _from_rows(values.get("totals", ())), set(values.get("folded", ()))

    def _replace(self, path: Path, values: Mapping[str, Any]) -> None:
        # Not by `atomic_path`, which would remove the files of ended processes before they are folded.
        part = path.with_name(f".{path.stem}-{describe_owner()}.part")
        try:
            part.write_text(json.dumps(values))
        except FileNotFoundError:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.write_text(json.dumps(values))
        part.replace(path)

    def _remove_parts(self) -> None:
        for part in self._folder.glob(".*.part"):
            if is_abandoned(part):
                part.unlink(missing_ok=True)


def add_counts(sums: dict[Sample, float], more: Mapping[Sample, float]) -> None:
    """Adds counts to others.

    Args:
        sums: by sample; changed.
        more: what is added.

    >>> sums = {("genre_stages_total",): 1.0}
    >>> add_counts(sums, {("genre_stages_total",): 2.0})
    >>> sums
    {('genre_stages_total',): 3.0}
    """
    for sample, value in more.items():
        sums[sample] = sums.get(sample, 0.0) + value


def _read_counts(path: Path) -> Counts:
    values = _read_json(path)
    return Counts(_from_rows(values.get("totals", ())), _from_rows(values.get("running", ())))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError):
        # Only a loss of power leaves half a file behind. Prometheus takes smaller counts for a restart.
        return {}
    return values if isinstance(values, dict) else {}


def _as_rows(counts: Mapping[Sample, float]) -> list[list[Any]]:
    return [[list(sample), value] for sample, value in counts.items()]


def _from_rows(rows: Iterable[Any]) -> dict[Sample, float]:
    return {tuple(sample): value for sample, value in rows}


def _is_foreign(path: Path) -> bool:
    machine = describe_owner().partition("-")[0]
    return not path.name.startswith(f"process-{machine}-")


def _is_old_foreign(path: Path) -> bool:
    try:
        return _is_foreign(path) and time.time() - path.stat().st_mtime > _FOREIGN_AGE_S
    except FileNotFoundError:
        return False
