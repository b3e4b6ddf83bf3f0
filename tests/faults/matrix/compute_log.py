"""What the processes of workers have noted: which stages were computed, cut short, or computed twice."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.faults.matrix.fault_hooks import COMPUTED


@dataclass(frozen=True)
class Note:
    """A line of the log.

    Attributes:
        time: of the system's monotonic clock, the same for all processes of the machine.
        event: ``start``, ``done`` or ``failed`` of a computation; ``fault`` for an armed fault that was taken.
        pid: the process.
        key: of the artifact.
        stage: its stage.
        log: its log.
        store: its store.
        why: of what failed.
        fault: name of the armed fault.
        point: where it was armed.
    """

    time: float
    event: str
    pid: int
    key: str = ""
    stage: str = ""
    log: str = ""
    store: str = ""
    why: str = ""
    fault: str = ""
    point: str = ""


@dataclass(frozen=True)
class Computations:
    """What a list of notes says.

    Attributes:
        computed: artifacts that were computed to the end.
        twice: computations to the end of an artifact that had been computed to the end before.
        cut_short: computations that neither ended nor failed, as their process was killed.
        failed: computations that ended in an error.
    """

    computed: int = 0
    twice: int = 0
    cut_short: int = 0
    failed: int = 0
    doubled: list[str] = field(default_factory=list)


def read_notes(folder: Path, store: str | None = None) -> list[Note]:
    """Reads the log, only of one store if it is named; a line that is being written is left out."""
    path = folder / COMPUTED
    if not path.exists():
        return []
    lines = path.read_text().split("\n")[:-1]
    notes = [Note(**json.loads(line)) for line in lines]
    return [note for note in notes if store is None or note.store == store]


def count_computations(notes: Iterable[Note]) -> Computations:
    """Counts computations by key; all notes are of one store."""
    events = list(notes)
    done = Counter(note.key for note in events if note.event == "done")
    starts = sum(note.event == "start" for note in events)
    failed = sum(note.event == "failed" for note in events)
    stages = {note.key: note.stage for note in events}
    return Computations(
        computed=len(done),
        twice=sum(count - 1 for count in done.values()),
        cut_short=starts - done.total() - failed,
        failed=failed,
        doubled=sorted(f"{stages[key]} {key[:12]}" for key, count in done.items() if count > 1),
    )


def find_running(notes: Sequence[Note], moment: float) -> set[str]:
    """Logs of which a stage was being computed at a moment."""
    running: dict[tuple[int, str], str] = {}
    for note in notes:
        if note.time > moment:
            break
        if note.event == "start":
            running[note.pid, note.key] = note.log
        elif note.event in ("done", "failed"):
            running.pop((note.pid, note.key), None)
    return set(running.values())


def measure_recovery(notes: Sequence[Note], moment: float, logs: set[str]) -> float | None:
    """Seconds from a fault until a stage is done of every log that it hit, or of any log if it hit none.

    Args:
        notes: in the order of time.
        moment: of the fault.
        logs: that the fault hit.

    Returns:
        Seconds; ``None`` where nothing was left to compute.
    """
    later = [note for note in notes if note.event == "done" and note.time > moment]
    if not logs:
        return later[0].time - moment if later else None
    firsts = [next((note.time for note in later if note.log == log), None) for log in logs]
    # The fault may have hit a log's last stage after it was done.
    found = [first - moment for first in firsts if first is not None]
    return max(found) if found else None
