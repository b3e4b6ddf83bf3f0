"""What the plausibility checks say of a chunk of a log, sound or with one fault."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from benchmarks.common.bench import Row
from benchmarks.common.task import require_log_folder
from benchmarks.log_faults.changed_log import ChangedLog
from benchmarks.log_faults.faults import Fault
from genre_tasks.log_checks.calibration import measure_agreement
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.log_checks.plausibility import assess_plausibility
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import DrivingLog, Sweep

_CHUNK_FRAMES = 20
# Cameras of a faulty log: more of them have the same fault.
_FAULTY_CAMERAS = 3


@dataclass(frozen=True)
class ChunkOfLog:
    """A chunk of a sound log.

    Attributes:
        uri: of the log; ``kitti:FOLDER`` is written in the PandaSet layout first.
        chunk: its index.
    """

    uri: str
    chunk: int

    @classmethod
    def of_street(cls, seed: str, parameters: str) -> ChunkOfLog:
        """The first chunk of a street.

        Args:
            seed: of the street.
            parameters: further ones of its URI.
        """
        return cls(f"synthetic:street?seed={seed}&{parameters}", 0)

    @property
    def name(self) -> str:
        """For people and file names."""
        kind, _, rest = self.uri.partition(":")
        if kind == "synthetic":
            return rest.partition("?")[2].partition("&")[0]
        return f"{Path(rest).name} chunk {self.chunk}"

    def frames(self, log: DrivingLog) -> tuple[int, ...]:
        """Log frames of the chunk."""
        start = self.chunk * _CHUNK_FRAMES
        return tuple(range(start, min(start + _CHUNK_FRAMES, log.frame_count)))


class _CachedSweeps:
    """A log whose sweeps are read once: each fault would read them again."""

    def __init__(self, log: DrivingLog) -> None:
        self._log = log
        self._sweeps: dict[int, Sweep | None] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)

    def sweep(self, frame: int) -> Sweep | None:
        """See ``DrivingLog``."""
        if frame not in self._sweeps:
            self._sweeps[frame] = self._log.sweep(frame)
        return self._sweeps[frame]


@dataclass(frozen=True)
class _OpenLog:
    """A log, the same with its sweeps in memory, and the folder that goes when the log does."""

    log: DrivingLog
    cached: Any
    folder: tempfile.TemporaryDirectory[str] | None = None


# One log only: faults follow one another on the same log, whose images are drawn once.
@lru_cache(maxsize=1)
def _open_chunk_log(uri: str) -> _OpenLog:
    require_log_folder(uri)
    if not uri.startswith("kitti:"):
        log = open_log(uri)
        return _OpenLog(log, _CachedSweeps(log))
    folder = tempfile.TemporaryDirectory(prefix="genre-kitti-")
    written = write_pandaset(open_log(uri), Path(folder.name) / "0009")
    log = open_log(f"pandaset:{written}")
    return _OpenLog(log, _CachedSweeps(log), folder)


def measure_sound_log(chunk: ChunkOfLog) -> Row:
    """Measures a log that nothing is wrong with.

    Args:
        chunk: of the log.

    Returns:
        A row: ``words`` of findings; ``scores``, agreement of edges by camera; ``cpu_seconds``.

    Raises:
        NotMeasuredError: the log's folder is missing.
    """
    log = _open_chunk_log(chunk.uri).log
    frames = chunk.frames(log)
    # Twice, because a street draws its images when they are first asked for.
    found = assess_plausibility(log, frames, log.cameras)
    start = time.process_time()
    assess_plausibility(log, frames, log.cameras)
    seconds = time.process_time() - start
    sample = LogSample(log, frames, log.cameras)
    scores = {}
    for camera in log.cameras:
        agreement = measure_agreement(sample, camera)
        if agreement is not None:
            scores[camera.name] = round(agreement.score, 2)
    row: Row = {"log": chunk.uri, "name": chunk.name, "fault": "none", "words": _words(found)}
    return row | {"scores": scores, "cpu_seconds": round(seconds, 3)}


def measure_fault(chunk: ChunkOfLog, fault: Fault) -> Row:
    """Measures at which strengths a fault is found.

    Args:
        chunk: of the sound log.
        fault: what is done to it.

    Returns:
        A row: ``strengths``, and ``found``, the words of findings for each of them.

    Raises:
        NotMeasuredError: the log's folder is missing.
    """
    log = _open_chunk_log(chunk.uri).cached
    found = []
    for strength in fault.strengths:
        changed = ChangedLog(log, fault.change(log, strength))
        found.append(_words(assess_plausibility(changed, chunk.frames(log), changed.cameras[:_FAULTY_CAMERAS])))
    row: Row = {"log": chunk.uri, "name": chunk.name, "fault": fault.name, "unit": fault.unit}
    return row | {"strengths": list(fault.strengths), "found": found}


def _words(findings: tuple[Finding, ...]) -> list[str]:
    """Words without repetitions: several cameras have the same one."""
    return list(dict.fromkeys(finding.word for finding in findings))
