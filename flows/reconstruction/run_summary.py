"""What a run's report and tables show: plain values, no torch and no files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class StageSummary:
    """One stage of one chunk.

    Attributes:
        stage: the stage's name.
        key: the artifact's key.
        cached: whether the artifact was in the store already.
        seconds: wall time of the computation, also if it was done by an earlier run.
        peak_mib: largest memory of the process during the computation, MiB.
        metrics: value by name, such as ``interpolation/psnr`` or ``shift_3m/kernel``; ``…/n`` is a number of images.
        pictures: PNG bytes by name, such as ``3m_left_front_camera_04``; ``.truth`` follows the name for a true image.
        curve: (seconds of iterations so far in this stage, held-out PSNR in dB).
        warnings: sentences for the user.
        intervals: 95 % interval of some metrics, by their name.
    """

    stage: str
    key: str
    cached: bool
    seconds: float
    peak_mib: float
    metrics: Mapping[str, float] = field(default_factory=dict)
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    curve: tuple[tuple[float, float], ...] = ()
    warnings: tuple[str, ...] = ()
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class ChunkSummary:
    """One chunk of a run.

    Attributes:
        chunk: number of the chunk.
        stages: its stages, in the order in which they ran.
        warnings: what its log lacks, and what it was made with if that is not what the user asked for.
    """

    chunk: int
    stages: tuple[StageSummary, ...]
    warnings: tuple[str, ...] = ()

    def stage(self, name: str) -> StageSummary | None:
        """Finds a stage by its name.

        Args:
            name: such as ``gnet`` or ``evaluate/gnet``.

        Returns:
            The stage, or ``None`` if the chunk does not have it.

        >>> ChunkSummary(0, (StageSummary("gnet", "5f41", False, 4.0, 900.0),)).stage("gnet").seconds
        4.0
        """
        return next((stage for stage in self.stages if stage.stage == name), None)


@dataclass(frozen=True)
class RunSummary:
    """A finished run.

    Attributes:
        run: the run's name.
        log: the log's URI.
        preset: the preset that the run started from.
        store: folder (or URI) of the store.
        chunks: the chunks that were reconstructed.
        differs: (the preset's value, the value used) of each ``section.key`` that was set otherwise.
    """

    run: str
    log: str
    preset: str
    store: str
    chunks: tuple[ChunkSummary, ...]
    differs: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
