"""What a run's report and tables show: plain values, no torch and no files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class StageSummary:
    """One stage of one chunk.

    ``metrics`` maps a name like ``interpolation/psnr`` or ``shift_3m/kernel`` to its value (``…/n`` to the number of
    images), ``intervals`` some of these names to a 95 % interval. ``pictures`` maps a name like
    ``3m_left_front_camera_04`` (with ``.truth`` for the true image) to PNG bytes. ``curve`` lists (seconds of
    iterations so far in this stage, held-out PSNR).
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
    """One chunk: its stages in the order in which they ran, and what its log lacks."""

    chunk: int
    stages: tuple[StageSummary, ...]
    warnings: tuple[str, ...] = ()

    def stage(self, name: str) -> StageSummary | None:
        """The stage of that name, or ``None``."""
        return next((s for s in self.stages if s.stage == name), None)


@dataclass(frozen=True)
class RunSummary:
    """A finished run. ``differs`` maps a setting to (the preset's value, the value used)."""

    run: str
    log: str
    preset: str
    store: str
    chunks: tuple[ChunkSummary, ...]
    differs: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
