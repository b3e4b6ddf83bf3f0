"""Results of checking a driving log: what each camera and the log as a unit has and lacks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from genre_tasks.log_checks.standstill import STANDSTILL_M
from genre_tasks.logs.findings import Finding

Verdict = Literal["good", "usable", "unusable"]


@dataclass(frozen=True)
class CameraCheck:
    """What one camera has and lacks.

    Attributes:
        name: the camera.
        width_px: native width of its images.
        height_px: native height of its images.
        missing: frames without an image.
        unreadable: frames whose image cannot be decoded, or is refused.
        odd_size: frames whose image has another size.
        blank: frames whose image has one colour all over.
    """

    name: str
    width_px: int
    height_px: int
    missing: tuple[int, ...]
    unreadable: tuple[int, ...]
    odd_size: tuple[int, ...]
    blank: tuple[int, ...] = ()


@dataclass(frozen=True)
class LogCheck:
    """What ``check_log`` found.

    Attributes:
        uri: the log.
        frames: how many frames it has.
        duration_s: seconds from the first frame to the last.
        cameras: one entry per camera.
        missing_sweeps: frames without a LiDAR sweep.
        unreadable_sweeps: frames whose sweep cannot be read.
        points: fewest, median and most points of the readable sweeps.
        tracks_moving: annotated objects that move.
        tracks_static: annotated objects that do not.
        invalid: (kind, count) of what the reader left out.
        travel_m: length of the ego vehicle's path.
        chunk_travel_m: for every chunk, the largest distance from its first position; NaN where it is not known.
        findings: everything to know, in the order in which it was found.
    """

    uri: str
    frames: int
    duration_s: float
    cameras: tuple[CameraCheck, ...]
    missing_sweeps: tuple[int, ...]
    unreadable_sweeps: tuple[int, ...]
    points: tuple[int, int, int]
    tracks_moving: int
    tracks_static: int
    invalid: tuple[tuple[str, int], ...]
    travel_m: float
    chunk_travel_m: tuple[float, ...]
    findings: tuple[Finding, ...]

    @property
    def chunk_count(self) -> int:
        """How many chunks the log is cut into."""
        return len(self.chunk_travel_m)

    @property
    def standstill_chunks(self) -> tuple[int, ...]:
        """The chunks in which the ego vehicle moves less than ``STANDSTILL_M``."""
        return tuple(k for k, travel in enumerate(self.chunk_travel_m) if travel < STANDSTILL_M)

    @property
    def verdict(self) -> Verdict:
        """Whether the log can be reconstructed.

        Returns:
            ``unusable`` if any finding is fatal, ``usable`` with warnings, else ``good``.
        """
        severities = {finding.severity for finding in self.findings}
        if "fatal" in severities:
            return "unusable"
        return "usable" if "warning" in severities else "good"
