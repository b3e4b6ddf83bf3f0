"""Ingest: a driving log to chunks of coloured points, actors and views in a local frame (paper Sec. III-A, IV-A)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.config import IngestConfig
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import Camera, DrivingLog, Float32, Float64
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Actor, Chunk, Mark, MarkKind, Points, View
from genre_tasks.scene.facade_completion import wall_fill
from genre_tasks.scene.image_decoding import decode_pixels, encoded_size
from genre_tasks.scene.moving_actors import Movers, Path, inside_box, movers
from genre_tasks.scene.ply_reader import read_ply
from genre_tasks.scene.road_completion import road_fill
from genre_tasks.scene.transforms import se3_inverse
from genre_tasks.scene.visibility import Cloud, color_clouds

STANDSTILL_M = 0.1
"""An ego vehicle that travels less than this in a chunk stands still: there is no parallax."""

EGO_BOX_M = (2.6, 1.3, 2.6)
"""Half length, width and height, about the LiDAR pose, of what is the ego vehicle itself and its sensors. Some logs
put that pose on the road, others at the sensor: the height covers both."""

NO_SWEEP = -1
"""The frame of points that are of no sweep: those of a file, and of the road where LiDAR is blind."""

_REMEDY = "Fetch the file again, or run without strict to go on without it."


def chunk_count(config: IngestConfig, log: DrivingLog) -> int:
    """How many chunks a log has; the last one may be short."""
    return -(-log.frame_count // config.chunk_frames)


@dataclass(frozen=True)
class _Reading:
    """What the steps of reading one chunk share; ``marks`` grows."""

    config: IngestConfig
    log: DrivingLog
    chunk: int
    frames: tuple[int, ...]
    world_SE3_chunk: Float64
    chunk_SE3_ego: Float64
    marks: list[Mark]
    progress: Progress

    def report(self, done: int, note: str) -> None:
        """Steps: images of each frame, sweeps of each frame, then colours as many."""
        self.progress(done, 3 * len(self.frames), note)

    def error(self, problem: str, remedy: str, camera: str | None = None, frame: int | None = None) -> InputError:
        return InputError(problem, remedy=remedy, log=self.log.name, chunk=self.chunk, camera=camera, frame=frame)


def ingest(config: IngestConfig, log: DrivingLog, chunk_index: int, progress: Progress = silent) -> Chunk:
    """Reads one chunk of a log.

    Every ``source_every``-th frame of the chunk is a source view, the others are held out; points take their colours
    from source views only. What is missing or unreadable becomes a ``Mark``, or an ``InputError`` under ``strict``.
    Raises ``InputError`` for fewer than two source frames with images, or no LiDAR and no ``points``; ``ConfigError``
    for an unknown chunk or camera.
    """
    frames = _frames(config, log, chunk_index)
    cameras = _cameras(config, log)
    poses = np.stack([log.world_SE3_lidar(f) for f in frames])
    world_SE3_chunk = np.eye(4)
    world_SE3_chunk[:3, 3] = poses[len(frames) // 2, :3, 3]
    chunk_SE3_ego = se3_inverse(world_SE3_chunk) @ poses
    reading = _Reading(config, log, chunk_index, frames, world_SE3_chunk, chunk_SE3_ego, [], progress)
    reading.marks.extend(_path_marks(log, frames, chunk_SE3_ego))
    views, pixels = _views(reading, cameras)
    sources = {v.frame for v in views if v.role == "source"}
    if len(sources) < 2:
        problem = f"the chunk has {len(sources)} source frames with images, at least two are needed"
        raise reading.error(problem, "Choose other chunks with --chunks, or a smaller ingest.source_every.")
    if config.points is not None:
        static, actors, given = _from_file(reading, config.points)
    else:
        (static, actors), given = _from_sweeps(reading, [v for v in views if v.role == "source"]), None
    clouds = [static, *actors]
    colored = color_clouds(clouds, _reported(reading, views, pixels))
    if given is not None:
        colored[0] = (given, np.ones(len(given), dtype=bool))
    points = [Points(c.positions, *colors, c.frames) for c, colors in zip(clouds, colored, strict=True)]
    reading.report(3 * len(frames), "ingest")
    return Chunk(
        log.dataset,
        log.name,
        chunk_index,
        frames,
        tuple(c.name for c in cameras),
        config.width_px,
        config.height_px,
        world_SE3_chunk,
        chunk_SE3_ego,
        tuple(views),
        points[0],
        tuple(_actor(c.path, p) for c, p in zip(actors, points[1:], strict=True) if c.path),
        tuple(reading.marks),
    )


def _frames(config: IngestConfig, log: DrivingLog, chunk_index: int) -> tuple[int, ...]:
    count = chunk_count(config, log)
    if not 0 <= chunk_index < count:
        known = "it has none" if count == 0 else f"it has 0 to {count - 1}"
        raise ConfigError(
            f"the log has no chunk {chunk_index}",
            remedy=f"Choose from its chunks with --chunks: {known}.",
            log=log.name,
        )
    start = chunk_index * config.chunk_frames
    return tuple(range(start, min(start + config.chunk_frames, log.frame_count)))


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


def _views(reading: _Reading, cameras: Sequence[Camera]) -> tuple[list[View], list[NDArray[np.uint8] | None]]:
    """Views in order, and the decoded pixels of source views (``None`` for held-out ones)."""
    config, log = reading.config, reading.log
    views: list[View] = []
    pixels: list[NDArray[np.uint8] | None] = []
    chunk_SE3_world = se3_inverse(reading.world_SE3_chunk)
    for n, frame in enumerate(reading.frames):
        reading.report(n, "images")
        source = n % config.source_every == 0
        for camera in cameras:
            data = log.image_bytes(camera.name, frame)
            problem, decoded = ("there is no image", None) if data is None else _decode(config, camera, data)
            if data is None or problem:
                if config.strict:
                    raise reading.error(problem, _REMEDY, camera.name, frame)
                kind: MarkKind = "missing_image" if data is None else "unreadable_image"
                reading.marks.append(Mark(kind, problem, frame=frame, camera=camera.name))
                continue
            pose = chunk_SE3_world @ log.world_SE3_camera(camera.name, frame)
            lens = camera.lens.resized(config.width_px, config.height_px)
            time_s = log.camera_timestamp_s(camera.name, frame)
            views.append(View(camera.name, frame, "source" if source else "heldout", time_s, pose, lens, data))
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


def _from_file(reading: _Reading, file: str) -> tuple[Cloud, list[Cloud], NDArray[np.uint8] | None]:
    """(background, no actors, the file's colours if it has any)."""
    positions, colors = read_ply(file)
    local = (positions - reading.world_SE3_chunk[:3, 3]).astype(np.float32)
    for path in _movers(reading).kept:
        reading.marks.append(Mark("actor_few_points", f"track {path.track_id}: points come from a file"))
    return Cloud(local, np.full(len(local), NO_SWEEP, np.int16)), [], colors


def _from_sweeps(reading: _Reading, sources: Sequence[View]) -> tuple[Cloud, list[Cloud]]:
    """(background, actors) of the chunk's LiDAR sweeps, and what the background is completed by."""
    moving = _movers(reading)
    static: list[tuple[int, Float32]] = []
    own: list[list[tuple[int, Float32]]] = [[] for _ in moving.kept]
    for n, frame in enumerate(reading.frames):
        reading.report(len(reading.frames) + n, "sweeps")
        points = _sweep(reading, frame)
        if points is None:
            continue
        points = _without_ego(points, reading.chunk_SE3_ego[n])
        left = np.ones(len(points), dtype=bool)
        for k, path in enumerate((*moving.kept, *moving.brief)):
            index, box = inside_box(points, path, frame)
            fresh = left[index]
            left[index] = False
            if k < len(own) and fresh.any():
                own[k].append((frame, box[fresh]))
        static.append((frame, points[left]))
    if not static:
        remedy = "Give points by ingest.points=FILE.ply, or choose other chunks with --chunks."
        raise reading.error("the chunk has no LiDAR sweep", remedy)
    swept = np.concatenate([p for _, p in static])
    static.append((NO_SWEEP, road_fill(swept, reading.chunk_SE3_ego)))
    if reading.config.complete_facades:
        static.append((NO_SWEEP, wall_fill(swept, reading.chunk_SE3_ego, sources)))
    actors = []
    for parts, path in zip(own, moving.kept, strict=True):
        count = sum(len(p) for _, p in parts)
        if count < reading.config.min_actor_points or len(parts) < reading.config.min_actor_frames:
            detail = f"track {path.track_id}: {count} LiDAR points in {len(parts)} frames"
            reading.marks.append(Mark("actor_few_points", detail))
        else:
            actors.append(_cloud(parts, path))
    return _cloud(static, None), actors


def _movers(reading: _Reading) -> Movers:
    config = reading.config
    found = movers(
        reading.log.tracks(),
        reading.frames,
        reading.world_SE3_chunk,
        config.min_actor_travel_m,
        config.min_actor_frames,
    )
    reading.marks.extend(found.marks)
    return found


def _cloud(parts: list[tuple[int, Float32]], path: Path | None) -> Cloud:
    frames = np.repeat(np.array([f for f, _ in parts], np.int16), [len(p) for _, p in parts])
    return Cloud(np.concatenate([p for _, p in parts]), frames, path)


def _sweep(reading: _Reading, frame: int) -> Float32 | None:
    """Points [P, 3] of a sweep in chunk coordinates; subtraction in float64, non-finite returns dropped."""
    try:
        sweep = reading.log.sweep(frame)
    except InputError as error:
        if reading.config.strict:
            raise
        reading.marks.append(Mark("unreadable_sweep", error.problem, frame=frame))
        return None
    if sweep is None:
        if reading.config.strict:
            raise reading.error("there is no LiDAR sweep", _REMEDY, frame=frame)
        reading.marks.append(Mark("missing_sweep", "there is no LiDAR sweep", frame=frame))
        return None
    points = (sweep.points_world - reading.world_SE3_chunk[:3, 3]).astype(np.float32)
    return points[np.isfinite(points).all(1)]


def _without_ego(points: Float32, chunk_SE3_ego: Float64) -> Float32:
    """Points that are not on the ego vehicle itself."""
    local = (points - chunk_SE3_ego[:3, 3].astype(np.float32)) @ chunk_SE3_ego[:3, :3].astype(np.float32)
    return points[~(np.abs(local) < np.array(EGO_BOX_M, np.float32)).all(1)]


def _reported(
    reading: _Reading, views: list[View], pixels: list[NDArray[np.uint8] | None]
) -> Iterator[tuple[View, NDArray[np.uint8]]]:
    """Source views with their pixels, each reported as it is taken."""
    count = len(reading.frames)
    for n, (view, image) in enumerate(zip(views, pixels, strict=True)):
        if image is not None:
            reading.report(2 * count + n * count // len(views), "colours")
            yield view, image


def _actor(path: Path, points: Points) -> Actor:
    return Actor(path.track_id, path.label, path.size_m, path.frames, path.chunk_SE3_box, points)
