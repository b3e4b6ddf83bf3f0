"""The stage ``ingest``: a driving log becomes chunks of coloured points, actors and views (paper Sec. III-A, IV-A)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from genre_tasks.config import IngestConfig
from genre_tasks.errors import InputError
from genre_tasks.log_checks.images import LEFT_OUT
from genre_tasks.log_checks.plausibility import assess_plausibility
from genre_tasks.log_checks.reader_findings import collect_reader_findings
from genre_tasks.log_checks.standstill import STANDSTILL_M, measure_travel_m
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.log_selection import choose_working_size, chunk_count, select_cameras, select_frames
from genre_tasks.logs.types import Camera, DrivingLog
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.actor_track import ActorTrack
from genre_tasks.scene.chunk import MOST_FRAMES, Actor, Chunk, Points, View
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.scene.visibility import color_point_clouds
from genre_tasks.stages.chunk_reading import ChunkReading
from genre_tasks.stages.ingest_points import ChunkPoints, read_points_from_file, read_points_from_sweeps
from genre_tasks.stages.ingest_views import read_views, require_source_frames

__all__ = ["STANDSTILL_M", "chunk_count", "ingest"]

_NOTED_WITH_IMAGES = frozenset(LEFT_OUT)
SCENE_POINTS_MODULE = "genre_tasks.stages.scene_points"


def ingest(config: IngestConfig, log: DrivingLog, chunk_index: int, progress: Progress = silent) -> Chunk:
    """Reads one chunk of a log.

    Every ``source_every``-th frame of the chunk, or the next one with an image, has source views; others are held out.
    Points take their colours from source views only. What is missing or unreadable becomes a ``LogIssue``, or an
    ``InputError`` under ``strict``.

    Args:
        config: frames, cameras and resolution.
        log: to read.
        chunk_index: from 0 to :func:`chunk_count`.
        progress: called with the steps done and their total.

    Returns:
        The chunk, in coordinates of its own.

    Raises:
        InputError: fewer than two source frames have images, there is neither LiDAR nor ``points`` nor ``scene``, or
            the chunk lies beyond the frames that can be numbered.
        ConfigError: the chunk or a camera is unknown.
    """
    frames = select_frames(config, log, chunk_index)
    _require_numbered_frames(log, frames, chunk_index)
    cameras = select_cameras(config, log)
    _require_cameras(log, cameras, frames, chunk_index)
    width_px, height_px = choose_working_size(config, cameras)
    config = config.model_copy(update={"width_px": width_px, "height_px": height_px})
    poses = np.stack([log.world_SE3_lidar(frame) for frame in frames])
    world_SE3_chunk = np.eye(4)
    # A translation alone, to the middle of the path: coordinates are then small enough for float32.
    world_SE3_chunk[:3, 3] = poses[len(frames) // 2, :3, 3]
    chunk_SE3_ego = invert_se3(world_SE3_chunk) @ poses
    reading = ChunkReading(config, log, chunk_index, frames, world_SE3_chunk, chunk_SE3_ego, progress)
    _note_path_issues(reading)
    known = _note_reader_findings(reading, cameras, ())
    _note_findings(reading, assess_plausibility(log, frames, cameras))
    views, pixels = read_views(reading, cameras)
    sources = [view for view in views if view.role == "source"]
    require_source_frames(reading, sources)
    if config.points is not None:
        found = read_points_from_file(reading, config.points)
    elif config.scene is not None:
        # By name, as in the stage ``initial``: the renderer is part of this stage only where a scene is rendered.
        found = import_module(SCENE_POINTS_MODULE).read_points_from_scene(reading, config.scene, views)
    else:
        found = read_points_from_sweeps(reading, sources)
    # Sweeps and cuboids have been read by now.
    _note_reader_findings(reading, cameras, known)
    points = _color_points(reading, found, views, pixels)
    actors = [_build_actor(c.track, p) for c, p in zip(found.actors, points[1:], strict=True) if c.track]
    reading.report(3 * len(frames), "ingest")
    return Chunk(
        dataset=log.dataset,
        log=log.name,
        index=chunk_index,
        frames=frames,
        camera_names=tuple(camera.name for camera in cameras),
        width_px=width_px,
        height_px=height_px,
        world_SE3_chunk=world_SE3_chunk,
        chunk_SE3_ego=chunk_SE3_ego,
        views=tuple(views),
        static=points[0],
        actors=tuple(actors),
        log_issues=tuple(reading.log_issues),
    )


def _note_path_issues(reading: ChunkReading) -> None:
    """Notes timestamps out of order, and a vehicle that stands."""
    times = np.array([reading.log.frame_timestamp_s(frame) for frame in reading.frames], dtype=np.float64)
    # Written as a negation, so that NaN counts as out of order.
    bad = np.flatnonzero(~(np.diff(times) > 0))
    if len(bad):
        detail = f"{len(bad)} timestamps do not come after the one before them; frame numbers are used for the order"
        reading.add_issue("timestamps", detail, frame=reading.frames[int(bad[0]) + 1])
    travel = measure_travel_m(reading.chunk_SE3_ego[:, :3, 3])
    if travel < STANDSTILL_M:
        reading.add_issue("standstill", f"the ego vehicle travels {travel:.2f} m: no parallax")


def _require_numbered_frames(log: DrivingLog, frames: Sequence[int], chunk: int) -> None:
    """Raises before anything is read where points could not have the numbers of the chunk's frames."""
    if max(frames) >= MOST_FRAMES:
        problem = f"the log has more than {MOST_FRAMES:,} frames"
        remedy = "Divide the log, or leave the chunks beyond them out with --chunks."
        raise InputError(problem, remedy=remedy, log=log.name, chunk=chunk)


def _require_cameras(log: DrivingLog, cameras: tuple[Camera, ...], frames: Sequence[int], chunk: int) -> None:
    """Raises what ``genre check`` calls fatal: no camera at all, or one whose poses or times cannot be opened."""
    for camera in cameras:
        _require_times(log, camera, frames)
    if cameras:
        return
    findings = collect_reader_findings(log, range(log.frame_count), ())
    reasons = [finding for finding in findings if finding.severity != "note"]
    problem = "; ".join(["no camera has an image that can be read", *(reason.message for reason in reasons[:1])])
    remedy = (reasons[0].remedy if reasons else "") or "Copy the camera folders of the sequence."
    raise InputError(problem, remedy=remedy, log=log.name, chunk=chunk)


def _require_times(log: DrivingLog, camera: Camera, frames: Sequence[int]) -> None:
    """Raises the first frame's error where no frame has a time of this camera: a file is missing or damaged."""
    first: InputError | None = None
    for frame in frames:
        try:
            log.camera_timestamp_s(camera.name, frame)
        except InputError as error:
            first = first or error
        else:
            return
    if first is not None:
        raise first


def _note_reader_findings(
    reading: ChunkReading, cameras: tuple[Camera, ...], known: tuple[Finding, ...]
) -> tuple[Finding, ...]:
    """Notes what the reader left out and is not known yet, but for what reading the images notes for each of them."""
    findings = collect_reader_findings(reading.log, reading.frames, cameras)
    _note_findings(reading, [f for f in findings if f not in known and f.word not in _NOTED_WITH_IMAGES])
    return findings


def _note_findings(reading: ChunkReading, findings: Iterable[Finding]) -> None:
    """Notes what ``genre check`` would warn of; raises where the log cannot be reconstructed.

    Under ``strict``, a warning is an error too.
    """
    for finding in findings:
        stops = finding.severity == "fatal" or (finding.severity == "warning" and reading.config.strict)
        frame = finding.frames[0] if finding.frames else None
        if stops:
            raise reading.input_error(finding.message, finding.remedy, finding.camera, frame)
        if finding.severity == "warning":
            detail = f"{finding.message}. {finding.remedy}" if finding.remedy else finding.message
            reading.add_issue(finding.word, detail, frame, finding.camera)


def _report_images(
    reading: ChunkReading, views: Sequence[View], pixels: Sequence[NDArray[np.uint8] | None]
) -> Iterator[tuple[View, NDArray[np.uint8]]]:
    """Gives source views with their pixels, each reported as it is taken."""
    count = len(reading.frames)
    for n, (view, image) in enumerate(zip(views, pixels, strict=True)):
        if image is not None:
            reading.report(2 * count + n * count // len(views), "colours")
            yield view, image


def _color_points(
    reading: ChunkReading, found: ChunkPoints, views: Sequence[View], pixels: Sequence[NDArray[np.uint8] | None]
) -> list[Points]:
    """The points of the background and of each actor, coloured from the source views."""
    clouds = [found.background, *found.actors]
    # Background and actors together, because they hide each other.
    colored = color_point_clouds(clouds, _report_images(reading, views, pixels))
    # A file's own colours take precedence over those of the chunk's images.
    if found.background_colors is not None:
        colored[0] = (found.background_colors, np.ones(len(found.background_colors), dtype=bool))
    return [
        Points(cloud.positions, colors, is_colored, cloud.frames)
        for cloud, (colors, is_colored) in zip(clouds, colored, strict=True)
    ]


def _build_actor(track: ActorTrack, points: Points) -> Actor:
    return Actor(
        track_id=track.track_id,
        label=track.label,
        size_m=track.size_m,
        frames=track.frames,
        chunk_SE3_box=track.chunk_SE3_box,
        points=points,
    )
