"""Ingest: a driving log to chunks of coloured points, actors and views in a local frame (paper Sec. III-A, IV-A)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from genre_tasks.config import IngestConfig
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import Camera, DrivingLog, Float32, Float64
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.actors import Movers, Path, inside_box, movers
from genre_tasks.scene.chunk import Actor, Chunk, Mark, Points, View
from genre_tasks.scene.coloring import Cloud, color_clouds
from genre_tasks.scene.geometry import se3_inverse
from genre_tasks.scene.images import decode_pixels, encoded_size
from genre_tasks.scene.ply import read_ply

STANDSTILL_M = 0.1
"""An ego vehicle that travels less than this in a chunk stands still: there is no parallax."""

EGO_BOX_M = (2.6, 1.3)
"""Half length and half width, about the LiDAR and below it, of what is the ego vehicle itself."""

NO_SWEEP = -1
"""The frame of points that come from a file and not from a sweep."""

_IMAGE_REMEDY = "Fetch the file again, or run without strict to go on without it."


def chunk_count(config: IngestConfig, log: DrivingLog) -> int:
    """How many chunks a log has; the last one may be short."""
    return -(-log.frame_count // config.chunk_frames)


def ingest(config: IngestConfig, log: DrivingLog, chunk_index: int, progress: Progress = silent) -> Chunk:
    """Reads one chunk of a log.

    Every ``source_every``-th frame of the chunk is a source view, the others are held out; points take their colours
    from source views only. What is missing or unreadable becomes a ``Mark``, or an ``InputError`` under ``strict``.
    Raises ``InputError`` for fewer than two source frames with images, or no LiDAR and no ``points``; ``ConfigError``
    for an unknown chunk or camera.
    """
    frames = _frames(config, log, chunk_index)
    cameras = _cameras(config, log)
    where = {"log": log.name, "chunk": chunk_index}
    poses = np.stack([log.world_SE3_lidar(f) for f in frames])
    world_SE3_chunk = np.eye(4)
    world_SE3_chunk[:3, 3] = poses[len(frames) // 2, :3, 3]
    chunk_SE3_ego = se3_inverse(world_SE3_chunk) @ poses
    marks = _path_marks(log, frames, chunk_SE3_ego)
    steps = 3 * len(frames)
    views, pixels = _views(config, log, frames, cameras, world_SE3_chunk, chunk_index, marks, progress, steps)
    sources = sorted({v.frame for v in views if v.role == "source"})
    if len(sources) < 2:
        raise InputError(
            f"the chunk has {len(sources)} source frames with images, at least two are needed",
            remedy="Choose other chunks with --chunks, or a smaller ingest.source_every.",
            **where,  # type: ignore[arg-type]
        )
    moving = movers(log.tracks(), frames, world_SE3_chunk, config.min_actor_travel_m, config.min_actor_frames)
    marks.extend(moving.marks)
    static, actors = _clouds(config, log, frames, world_SE3_chunk, chunk_SE3_ego, moving, where, marks, progress)
    given = static[1]
    clouds = [static[0], *actors]
    images = _reported([(v, p) for v, p in zip(views, pixels, strict=True) if p is not None], progress, steps)
    colored = color_clouds(clouds, images)
    if given is not None:
        colored[0] = (given, np.ones(len(given), dtype=bool))
    points = [Points(c.positions, *colors, c.frames) for c, colors in zip(clouds, colored, strict=True)]
    progress(steps, steps, "ingest")
    return Chunk(
        log.dataset, log.name, chunk_index, tuple(frames), tuple(c.name for c in cameras), config.width_px,
        config.height_px, world_SE3_chunk, chunk_SE3_ego, tuple(views), points[0],
        tuple(_actor(c.path, p) for c, p in zip(actors, points[1:], strict=True) if c.path is not None), tuple(marks),
    )  # fmt: skip


def _frames(config: IngestConfig, log: DrivingLog, chunk_index: int) -> list[int]:
    count = chunk_count(config, log)
    if not 0 <= chunk_index < count:
        known = "it has none" if count == 0 else f"it has 0 to {count - 1}"
        raise ConfigError(
            f"the log has no chunk {chunk_index}",
            remedy=f"Choose from its chunks with --chunks: {known}.",
            log=log.name,
        )
    start = chunk_index * config.chunk_frames
    return list(range(start, min(start + config.chunk_frames, log.frame_count)))


def _cameras(config: IngestConfig, log: DrivingLog) -> tuple[Camera, ...]:
    if config.cameras is None:
        return log.cameras
    known = {c.name: c for c in log.cameras}
    unknown = [name for name in config.cameras if name not in known]
    if unknown or not config.cameras:
        raise ConfigError(
            f"unknown cameras {', '.join(unknown)}" if unknown else "no camera is chosen",
            remedy=f"Choose ingest.cameras from {', '.join(known)}.",
            log=log.name,
        )
    return tuple(c for c in log.cameras if c.name in config.cameras)


def _path_marks(log: DrivingLog, frames: Sequence[int], chunk_SE3_ego: Float64) -> list[Mark]:
    marks = []
    times = np.array([log.frame_timestamp_s(f) for f in frames], dtype=np.float64)
    bad = np.flatnonzero(~(np.diff(times) > 0))
    if len(bad):
        detail = f"{len(bad)} timestamps do not come after the one before them; frame numbers are used for the order"
        marks.append(Mark("timestamps", detail, frame=frames[int(bad[0]) + 1]))
    travel = np.linalg.norm(chunk_SE3_ego[:, :3, 3] - chunk_SE3_ego[0, :3, 3], axis=1).max()
    if travel < STANDSTILL_M:
        marks.append(Mark("standstill", f"the ego vehicle travels {travel:.2f} m: no parallax"))
    return marks


def _views(
    config: IngestConfig,
    log: DrivingLog,
    frames: Sequence[int],
    cameras: Sequence[Camera],
    world_SE3_chunk: Float64,
    chunk: int,
    marks: list[Mark],
    progress: Progress,
    steps: int,
) -> tuple[list[View], list[NDArray[np.uint8] | None]]:
    """Views in order, and the decoded pixels of source views (``None`` for held-out ones)."""
    views: list[View] = []
    pixels: list[NDArray[np.uint8] | None] = []
    chunk_SE3_world = se3_inverse(world_SE3_chunk)
    for n, frame in enumerate(frames):
        progress(n, steps, "images")
        for camera in cameras:
            data = log.image_bytes(camera.name, frame)
            problem, decoded = ("there is no image", None) if data is None else _decode(config, camera, data)
            if problem:
                if config.strict:
                    raise InputError(
                        problem, remedy=_IMAGE_REMEDY, log=log.name, chunk=chunk, camera=camera.name, frame=frame
                    )
                kind = "missing_image" if data is None else "unreadable_image"
                marks.append(Mark(kind, problem, frame=frame, camera=camera.name))  # type: ignore[arg-type]
                continue
            assert data is not None
            source = n % config.source_every == 0
            pose = chunk_SE3_world @ log.world_SE3_camera(camera.name, frame)
            views.append(
                View(
                    camera.name, frame, "source" if source else "heldout", log.camera_timestamp_s(camera.name, frame),
                    pose, camera.lens.resized(config.width_px, config.height_px), data,
                )
            )  # fmt: skip
            pixels.append(decoded if source else None)
    return views, pixels


def _decode(config: IngestConfig, camera: Camera, data: bytes) -> tuple[str, NDArray[np.uint8] | None]:
    """(what is wrong or "", pixels at the working resolution)."""
    try:
        size = encoded_size(data)
        pixels = decode_pixels(data, config.width_px, config.height_px)
    except InputError as error:
        return error.problem, None
    lens = camera.lens
    if abs(size[0] * lens.height_px - size[1] * lens.width_px) > 0.01 * size[0] * lens.height_px:
        return f"the image is {size[0]}×{size[1]}, the camera's lens is {lens.width_px}×{lens.height_px}", None
    return "", pixels


def _clouds(
    config: IngestConfig,
    log: DrivingLog,
    frames: Sequence[int],
    world_SE3_chunk: Float64,
    chunk_SE3_ego: Float64,
    moving: Movers,
    where: dict[str, object],
    marks: list[Mark],
    progress: Progress,
) -> tuple[tuple[Cloud, NDArray[np.uint8] | None], list[Cloud]]:
    """((the background, its colours where the user gave them), the actors' clouds)."""
    origin = world_SE3_chunk[:3, 3]
    if config.points is not None:
        positions, colors = read_ply(config.points)
        local = (positions - origin).astype(np.float32)
        marks.extend(Mark("actor_few_points", f"track {p.track_id}: points come from a file") for p in moving.kept)
        return (Cloud(local, np.full(len(local), NO_SWEEP, np.int16)), colors), []
    static: list[Float32] = []
    static_frames: list[int] = []
    own: dict[int, list[tuple[int, Float32]]] = {k: [] for k in range(len(moving.kept))}
    for n, frame in enumerate(frames):
        progress(len(frames) + n, 3 * len(frames), "sweeps")
        points = _sweep(config, log, frame, origin, where, marks)
        if points is None:
            continue
        points = _without_ego(points, chunk_SE3_ego[n])
        left = np.ones(len(points), dtype=bool)
        for k, path in enumerate((*moving.kept, *moving.brief)):
            index, box = inside_box(points, path, frame)
            fresh = left[index]
            left[index] = False
            if k in own and fresh.any():
                own[k].append((frame, box[fresh]))
        static.append(points[left])
        static_frames.append(frame)
    if not static:
        raise InputError(
            "the chunk has no LiDAR sweep", remedy="Give points by ingest.points=FILE.ply, or choose other chunks.",
            **where,  # type: ignore[arg-type]
        )  # fmt: skip
    actors = []
    for k, path in enumerate(moving.kept):
        cloud = _cloud(own[k], path)
        if len(cloud.positions) < config.min_actor_points or len(own[k]) < config.min_actor_frames:
            detail = f"track {path.track_id}: {len(cloud.positions)} LiDAR points in {len(own[k])} frames"
            marks.append(Mark("actor_few_points", detail))
        else:
            actors.append(cloud)
    return (_cloud(list(zip(static_frames, static, strict=True)), None), None), actors


def _cloud(parts: list[tuple[int, Float32]], path: Path | None) -> Cloud:
    positions = np.concatenate([p for _, p in parts]) if parts else np.empty((0, 3), np.float32)
    frames = np.repeat(np.array([f for f, _ in parts], np.int16), [len(p) for _, p in parts])
    return Cloud(np.ascontiguousarray(positions), frames, path)


def _sweep(
    config: IngestConfig,
    log: DrivingLog,
    frame: int,
    origin: Float64,
    where: dict[str, object],
    marks: list[Mark],
) -> Float32 | None:
    """Points [P, 3] of a sweep in chunk coordinates; subtraction in float64, non-finite returns dropped."""
    try:
        sweep = log.sweep(frame)
    except InputError as error:
        if config.strict:
            raise
        marks.append(Mark("unreadable_sweep", error.problem, frame=frame))
        return None
    if sweep is None:
        if config.strict:
            remedy = "Fetch the file again, or run without strict to go on without it."
            raise InputError("there is no LiDAR sweep", remedy=remedy, frame=frame, **where)  # type: ignore[arg-type]
        marks.append(Mark("missing_sweep", "there is no LiDAR sweep", frame=frame))
        return None
    points = (sweep.points_world - origin).astype(np.float32)
    return points[np.isfinite(points).all(1)]


def _without_ego(points: Float32, chunk_SE3_ego: Float64) -> Float32:
    """Points that are not on the ego vehicle itself."""
    local = (points - chunk_SE3_ego[:3, 3].astype(np.float32)) @ chunk_SE3_ego[:3, :3].astype(np.float32)
    on_ego = (np.abs(local[:, 0]) < EGO_BOX_M[0]) & (np.abs(local[:, 1]) < EGO_BOX_M[1]) & (local[:, 2] < 0)
    return points[~on_ego]


def _reported(
    images: list[tuple[View, NDArray[np.uint8]]], progress: Progress, steps: int
) -> list[tuple[View, NDArray[np.uint8]]]:
    """The same images; colouring is reported as one step."""
    progress(2 * steps // 3, steps, "colours")
    return images


def _actor(path: Path, points: Points) -> Actor:
    return Actor(path.track_id, path.label, path.size_m, path.frames, path.chunk_SE3_box, points)
