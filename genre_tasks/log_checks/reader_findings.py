"""What a log's reader left out or met: collected for ``genre check``, and for the stage ``ingest`` chunk by chunk."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from genre_tasks.errors import GenreError
from genre_tasks.logs.findings import Finding, ReportsFindings
from genre_tasks.logs.types import Camera, DrivingLog


def collect_reader_findings(log: DrivingLog, frames: Iterable[int], cameras: Iterable[Camera]) -> tuple[Finding, ...]:
    """Collects what the reader of a log left out, or met and does not read.

    Args:
        log: the log; a reader that reports nothing has no findings.
        frames: the frames that are used.
        cameras: the cameras that are used.

    Returns:
        Findings about these frames or about none in particular, and not about cameras that exist and are not used. Of
        those about frames, one stands for all of a word and a camera, since a log may have thousands of bad boxes: it
        has the first one's message and numbers, and the frames of all.
    """
    if not isinstance(log, ReportsFindings):
        return ()
    try:
        findings = log.findings()
        existing = {camera.name for camera in log.cameras}
    except GenreError:
        # Whoever reads what cannot be read reports it.
        return ()
    used_frames = set(frames)
    unused = existing - {camera.name for camera in cameras}
    groups: dict[tuple[str, ...], list[Finding]] = {}
    for finding in findings:
        if finding.camera in unused or (finding.frames and used_frames.isdisjoint(finding.frames)):
            continue
        key = (finding.word, str(finding.camera)) if finding.frames else (finding.word, finding.message)
        groups.setdefault(key, []).append(finding)
    return tuple(_merge(group) for group in groups.values())


def _merge(group: list[Finding]) -> Finding:
    first = group[0]
    if len(group) == 1:
        return first
    frames = tuple(sorted({frame for finding in group for frame in finding.frames}))
    return replace(first, message=f"{first.message} (and {len(group) - 1} more)", frames=frames)
