"""Checks what a driving log has and lacks, before hours are spent on it.

Every image is decoded, coarsely, and every sweep is read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from genre_tasks.log_checks.images import summarise_findings
from genre_tasks.log_checks.inspection import LogInspector
from genre_tasks.log_checks.plausibility import assess_plausibility
from genre_tasks.log_checks.reader_findings import collect_reader_findings
from genre_tasks.log_checks.results import LogCheck
from genre_tasks.log_checks.standstill import STANDSTILL_M, measure_travel_m
from genre_tasks.logs.findings import Finding, ReportsFindings, Severity, format_frames
from genre_tasks.logs.log_selection import count_source_frames
from genre_tasks.logs.types import DrivingLog, Float64
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import MOST_FRAMES

# With a single one, no point is seen from two positions of the same camera.
_MIN_SOURCE_FRAMES = 2
# A complete sweep has tens of thousands; fewer are a file that was cut off or a sensor that was covered.
_MIN_SWEEP_POINTS = 1000
# Sweeps of one sensor differ with what stands around it, and by less: such a part is half a turn or a cut file.
_MIN_SWEEP_PART = 0.25
_SEVERITIES: tuple[Severity, ...] = ("note", "warning", "fatal")


def check_log(log: DrivingLog, chunk_frames: int = 20, progress: Progress = silent, source_every: int = 4) -> LogCheck:
    """Reads every frame of a log once and reports what it has and lacks; never raises on what the log holds.

    Args:
        log: the log to read.
        chunk_frames: frames of a chunk, as in ``ingest.chunk_frames``; the last chunk may be shorter.
        progress: called once an image and once a sweep.
        source_every: distance of source frames, as in ``ingest.source_every``.

    Returns:
        Counts, and findings that say what to do about each fault.

    Example::

        check = check_log(open_log("pandaset:/data/pandaset/002"))
        print(check.verdict, [finding.message for finding in check.findings])
    """
    inspector = LogInspector(log, progress)
    positions = inspector.read_ego_positions()
    times = inspector.read_times()
    cameras = tuple(inspector.check_camera(index) for index in range(len(inspector.cameras)))
    missing, unreadable, point_counts = inspector.read_sweeps()
    tracks = inspector.try_reading(log.tracks, "warning", "unreadable_cuboids") or ()
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    chunk_starts = range(0, log.frame_count, chunk_frames)
    # Clocks that fail for some frames were reported; the others still say how long the log is.
    finite_times = times[np.isfinite(times)]
    check = LogCheck(
        uri=log.uri,
        frames=log.frame_count,
        duration_s=float(np.ptp(finite_times)) if finite_times.size else 0.0,
        cameras=cameras,
        missing_sweeps=missing,
        unreadable_sweeps=unreadable,
        points=_summarise_counts(tuple(point_counts.values())),
        tracks_moving=sum(track.moving for track in tracks),
        tracks_static=sum(not track.moving for track in tracks),
        invalid=_count_left_out(log, inspector),
        # A position that cannot be read leaves a gap in the path, not a path of unknown length.
        travel_m=float(np.nansum(steps_m)),
        chunk_travel_m=tuple(measure_travel_m(positions[start : start + chunk_frames]) for start in chunk_starts),
        findings=(),
    )
    _report_lost_chunks(positions, inspector, chunk_frames)
    _report_findings(check, inspector, chunk_frames)
    _report_chunks(check, inspector, chunk_frames, source_every)
    _report_small_sweeps(point_counts, inspector)
    _report_chunks_without_sources(check, inspector, chunk_frames, source_every)
    return replace(check, findings=tuple(inspector.findings))


def _report_lost_chunks(positions: Float64, inspector: LogInspector, chunk_frames: int) -> None:
    """Adds which chunks a run refuses, because the vehicle's pose [F, 3] cannot be read at one of their frames."""
    lost_frames = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    lost = sorted({int(frame) // chunk_frames for frame in lost_frames})
    if lost:
        chunk_count = -(-len(positions) // chunk_frames)
        message = f"chunks {format_frames(lost)} cannot be reconstructed: the vehicle's pose is unreadable"
        message += f" at frames {format_frames(lost_frames)}"
        remedy = "Correct the poses, or leave these chunks out with --chunks."
        severity: Severity = "fatal" if len(lost) == chunk_count else "warning"
        inspector.report(Finding("lost_chunk", severity, message, remedy, {"chunks": len(lost)}))


def _report_chunks_without_sources(
    check: LogCheck, inspector: LogInspector, chunk_frames: int, source_every: int
) -> None:
    """Adds which chunks a run refuses, because they have too few frames, or too few with images."""
    has_images: dict[str, NDArray[np.bool_]] = {}
    for camera in check.cameras:
        left_out = {*camera.missing, *camera.unreadable, *camera.odd_size, *camera.blank}
        poses = [f.frames for f in inspector.findings if f.word == "unreadable_pose" and f.camera == camera.name]
        left_out.update(frame for frames in poses for frame in frames)
        has_images[camera.name] = ~np.isin(np.arange(check.frames), list(left_out))
    # Without any image, another finding says so.
    if not any(has_image.any() for has_image in has_images.values()):
        return
    lost: list[int] = []
    # Also with all its images a chunk may have too few frames, as the last one of a log.
    too_short: list[int] = []
    short_frames: list[int] = []
    for chunk in range(check.chunk_count):
        frames = range(chunk * chunk_frames, min((chunk + 1) * chunk_frames, check.frames))
        of_chunk = {camera: has_image[frames.start : frames.stop].tolist() for camera, has_image in has_images.items()}
        if count_source_frames(source_every, {"any": [True] * len(frames)}) < _MIN_SOURCE_FRAMES:
            too_short.append(chunk)
            short_frames += frames
        elif count_source_frames(source_every, of_chunk) < _MIN_SOURCE_FRAMES:
            lost.append(chunk)
    is_all = len(lost) + len(too_short) == check.chunk_count
    if too_short:
        message = f"frames {format_frames(short_frames)} cannot be reconstructed: a chunk needs at least"
        message += f" {source_every + 1} frames (ingest.source_every = {source_every})"
        # A run leaves out the end of a log by itself; of a log of one chunk nothing would be left.
        severity: Severity = "fatal" if is_all else "note"
        remedy = "Set a smaller ingest.source_every."
        inspector.report(Finding("few_source_frames", severity, message, remedy, {"frames_needed": source_every + 1.0}))
    if lost:
        message = f"chunks {format_frames(lost)} cannot be reconstructed: they have fewer than two source frames with"
        message += f" images (ingest.source_every = {source_every})"
        severity = "fatal" if is_all else "warning"
        remedy = "Export the images that are left out, choose other chunks, or set a smaller ingest.source_every."
        inspector.report(Finding("few_source_frames", severity, message, remedy, {"chunks": len(lost)}))


def _summarise_counts(counts: Sequence[int]) -> tuple[int, int, int]:
    """Fewest, median and most; zeros where there are no counts."""
    if not counts:
        return (0, 0, 0)
    return (min(counts), int(np.median(counts)), max(counts))


def _count_left_out(log: DrivingLog, inspector: LogInspector) -> tuple[tuple[str, int], ...]:
    """(word, count) of what the reader left out, sorted by word."""
    if not isinstance(log, ReportsFindings):
        return ()
    findings = inspector.try_reading(log.findings, "warning", "unreadable_log") or ()
    words = [finding.word for finding in findings if finding.severity != "note"]
    return tuple((word, words.count(word)) for word in sorted(set(words)))


def _report_findings(check: LogCheck, inspector: LogInspector, chunk_frames: int) -> None:
    """Adds what the counts of a log mean for its reconstruction."""
    _report_cameras(check, inspector)
    _report_lidar(check, inspector)
    _report_reader_findings(inspector)
    if not check.tracks_moving and not check.tracks_static:
        message = "no cuboids: everything is taken as static"
        inspector.report(Finding("no_cuboids", "note", message, "Moving objects will smear."))
    _report_plausibility(inspector, chunk_frames)


def _report_reader_findings(inspector: LogInspector) -> None:
    """Adds what the reader left out, unless the images or sweeps showed the same thing of that camera already."""
    log = inspector.log
    known = {(finding.word, finding.camera) for finding in inspector.findings}
    for finding in collect_reader_findings(log, range(log.frame_count), inspector.cameras):
        if (finding.word, finding.camera) not in known:
            inspector.report(finding)


def _report_plausibility(inspector: LogInspector, chunk_frames: int) -> None:
    """Adds what is implausible, chunk by chunk as a run would meet it; each thing once, with the chunks it is in."""
    log = inspector.log
    found: dict[tuple[str, str | None, int], tuple[Finding, list[int]]] = {}
    for chunk, start in enumerate(range(0, log.frame_count, chunk_frames)):
        frames = tuple(range(start, min(start + chunk_frames, log.frame_count)))
        # One word may stand for two things of a camera, such as a readout and an exposure in milliseconds.
        counts: Counter[tuple[str, str | None]] = Counter()
        for finding in assess_plausibility(log, frames, inspector.cameras):
            subject = (finding.word, finding.camera)
            key = (*subject, counts[subject])
            counts[subject] += 1
            known, chunks = found.get(key, (finding, []))
            more_severe = _SEVERITIES.index(finding.severity) - _SEVERITIES.index(known.severity)
            # The first of the most severe: a note in an earlier chunk must not hide a warning, nor share its chunks.
            if more_severe > 0:
                found[key] = (finding, [chunk])
            elif more_severe == 0:
                found[key] = (known, [*chunks, chunk])
    for finding, chunks in found.values():
        suffix = f" (chunks {format_frames(chunks)})" if log.frame_count > chunk_frames else ""
        inspector.report(replace(finding, message=finding.message + suffix))


def _report_chunks(check: LogCheck, inspector: LogInspector, chunk_frames: int, source_every: int) -> None:
    if check.frames > MOST_FRAMES:
        message = f"chunks beyond the first {MOST_FRAMES:,} of {check.frames:,} frames cannot be reconstructed"
        remedy = "Divide the log, or leave these chunks out with --chunks."
        numbers = {"frames": float(check.frames), "limit": float(MOST_FRAMES)}
        inspector.report(Finding("too_many_frames", "warning", message, remedy, numbers))
    for chunk in check.standstill_chunks:
        # Of a few frames, nothing is reconstructed anyway: another finding says so.
        if min(chunk_frames, check.frames - chunk * chunk_frames) <= source_every:
            continue
        travel = check.chunk_travel_m[chunk]
        message = f"chunk {chunk}: the ego vehicle stands still ({travel:.2f} m), no parallax"
        remedy = "Novel views rest on the LiDAR alone there; leave it out with --chunks."
        numbers = {"travel_m": travel, "limit_m": STANDSTILL_M}
        inspector.report(Finding("standstill", "warning", message, remedy, numbers))
    last_chunk_frames = check.frames - (check.chunk_count - 1) * chunk_frames
    if last_chunk_frames < chunk_frames:
        message = f"the last chunk is short: {last_chunk_frames} of {chunk_frames} frames"
        inspector.report(Finding("short_chunk", "note", message))


def _report_cameras(check: LogCheck, inspector: LogInspector) -> None:
    if not check.cameras:
        message = "no camera has an image"
        remedy = "Copy the camera folders of the sequence; other findings name what lies in their place."
        if any(finding.word == "unreadable_camera" for finding in inspector.findings):
            message = "no camera can be used"
            remedy = "Correct what the findings on cameras name."
        inspector.report(Finding("no_images", "fatal", message, remedy))
    elif len(check.cameras) == 1:
        inspector.report(Finding("one_camera", "note", "one camera only", "Shifted views see more that no camera saw."))
    usable_images = 0
    for camera in check.cameras:
        left_out = {*camera.missing, *camera.unreadable, *camera.odd_size, *camera.blank}
        usable_images += check.frames - len(left_out)
        if camera.missing:
            message = f"{camera.name}: no image at frames {format_frames(camera.missing)}"
            finding = Finding("missing_image", "warning", message, "They are left out.", camera=camera.name)
            inspector.report(replace(finding, frames=camera.missing))
        for finding in summarise_findings(camera.name, inspector.image_findings[camera.name]):
            inspector.report(finding)
    if check.cameras and not usable_images:
        remedy = "Copy the camera folders of the sequence again, or export their images as 8-bit JPEG or PNG."
        inspector.report(Finding("no_readable_image", "fatal", "no image can be used", remedy))


def _report_lidar(check: LogCheck, inspector: LogInspector) -> None:
    readable_sweeps = check.frames - len(check.missing_sweeps) - len(check.unreadable_sweeps)
    if not readable_sweeps:
        message = "no LiDAR sweep can be read"
        inspector.report(Finding("no_lidar", "fatal", message, "Give points by ingest.points=FILE.ply."))
    elif check.missing_sweeps:
        message = f"no LiDAR sweep at frames {format_frames(check.missing_sweeps)}"
        finding = Finding("missing_sweep", "warning", message, "The other sweeps are used.")
        inspector.report(replace(finding, frames=check.missing_sweeps))
    if readable_sweeps and not check.points[-1]:
        message = "no LiDAR sweep has a point that can be used"
        inspector.report(Finding("no_lidar", "fatal", message, "Give points by ingest.points=FILE.ply."))


def _report_small_sweeps(point_counts: Mapping[int, int], inspector: LogInspector) -> None:
    """Adds which sweeps, of those with frame → point count, are empty or cut off."""
    # Where no sweep has a point, another finding says so.
    if not any(point_counts.values()):
        return
    median = float(np.median(list(point_counts.values())))
    limit = max(_MIN_SWEEP_POINTS, _MIN_SWEEP_PART * median)
    frames = tuple(frame for frame, count in sorted(point_counts.items()) if count < limit)
    if frames:
        fewest = min(point_counts[frame] for frame in frames)
        message = (
            f"sweeps of frames {format_frames(frames)} have few points, down to {fewest}; the median is {median:g}"
        )
        numbers = {"points": fewest, "limit": limit, "median": median}
        remedy = "Look at the LiDAR files of these frames; they are used as they are."
        inspector.report(Finding("few_lidar_points", "warning", message, remedy, numbers, frames=frames))
