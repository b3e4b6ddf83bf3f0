"""The stage ``ingest``: a driving log becomes chunks of coloured points, actors and views (paper Sec. III-A, IV-A)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from genre_tasks.config import IngestConfig
from genre_tasks.log_checks.plausibility import assess_plausibility
from genre_tasks.logs.log_selection import chunk_count, select_cameras, select_frames
from genre_tasks.logs.types import Camera, DrivingLog
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.actor_track import ActorTrack
from genre_tasks.scene.chunk import Actor, Chunk, Points, View
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.scene.visibility import color_point_clouds
from genre_tasks.stages.chunk_reading import ChunkReading
from genre_tasks.stages.ingest_points import read_points_from_file, read_points_from_sweeps
from genre_tasks.stages.ingest_views import read_views

__all__ = ["STANDSTILL_M", "chunk_count", "ingest"]

STANDSTILL_M = 0.1
"""An ego vehicle that travels less than this in a chunk stands still: there is no parallax."""


def ingest(config: IngestConfig, log: DrivingLog, chunk_index: int, progress: Progress = silent) -> Chunk:
    """Reads one chunk of a log.

    Every ``source_every``-th frame of the chunk is a source view, the others are held out. Points take their colours
    from source views only. What is missing or unreadable becomes a ``LogIssue``, or an ``InputError`` under ``strict``.

    Args:
        config: frames, cameras and resolution.
        log: to read.
        chunk_index: from 0 to :func:`chunk_count`.
        progress: called with the steps done and their total.

    Returns:
        The chunk, in coordinates of its own.

    Raises:
        InputError: fewer than two source frames have images, or there is neither LiDAR nor ``points``.
        ConfigError: the chunk or a camera is unknown.
    """
    frames = select_frames(config, log, chunk_index)
    cameras = select_cameras(config, log)
    poses = np.stack([log.world_SE3_lidar(frame) for frame in frames])
    world_SE3_chunk = np.eye(4)
    # A translation alone, to the middle of the path: coordinates are then small enough for float32.
    world_SE3_chunk[:3, 3] = poses[len(frames) // 2, :3, 3]
    chunk_SE3_ego = invert_se3(world_SE3_chunk) @ poses
    reading = ChunkReading(config, log, chunk_index, frames, world_SE3_chunk, chunk_SE3_ego, progress)
    _note_path_issues(reading)
    _note_implausible(reading, cameras)
    views, pixels = read_views(reading, cameras)
    sources = [view for view in views if view.role == "source"]
    # Frames and not views: six cameras at one moment have no parallax over time.
    source_frames = {view.frame for view in sources}
    if len(source_frames) < 2:
        problem = f"the chunk has {len(source_frames)} source frames with images, at least two are needed"
        raise reading.input_error(problem, "Choose other chunks with --chunks, or a smaller ingest.source_every.")
    if config.points is not None:
        found = read_points_from_file(reading, config.points)
    else:
        found = read_points_from_sweeps(reading, sources)
    clouds = [found.background, *found.actors]
    # Background and actors together, because they hide each other.
    colored = color_point_clouds(clouds, _report_images(reading, views, pixels))
    # A file's own colours take precedence over those of the chunk's images.
    if found.background_colors is not None:
        colored[0] = (found.background_colors, np.ones(len(found.background_colors), dtype=bool))
    points = [
        Points(cloud.positions, colors, is_colored, cloud.frames)
        for cloud, (colors, is_colored) in zip(clouds, colored, strict=True)
    ]
    actors = [_build_actor(c.track, p) for c, p in zip(found.actors, points[1:], strict=True) if c.track]
    reading.report(3 * len(frames), "ingest")
    return Chunk(
        dataset=log.dataset,
        log=log.name,
        index=chunk_index,
        frames=frames,
        camera_names=tuple(camera.name for camera in cameras),
        width_px=config.width_px,
        height_px=config.height_px,
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
    centers = reading.chunk_SE3_ego[:, :3, 3]
    travel = np.linalg.norm(centers - centers[0], axis=1).max()
    if travel < STANDSTILL_M:
        reading.add_issue("standstill", f"the ego vehicle travels {travel:.2f} m: no parallax")


def _note_implausible(reading: ChunkReading, cameras: tuple[Camera, ...]) -> None:
    """Notes what ``genre check`` would warn of; raises where the log cannot be reconstructed.

    Under ``strict``, a warning is an error too.
    """
    for finding in assess_plausibility(reading.log, reading.frames, cameras):
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


def _build_actor(track: ActorTrack, points: Points) -> Actor:
    return Actor(
        track_id=track.track_id,
        label=track.label,
        size_m=track.size_m,
        frames=track.frames,
        chunk_SE3_box=track.chunk_SE3_box,
        points=points,
    )
