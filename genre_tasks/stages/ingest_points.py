"""Points of a chunk: from LiDAR sweeps, divided into background and moving actors, or from a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.config import FilePlacement
from genre_tasks.errors import InputError
from genre_tasks.logs.types import CuboidTrack, Float32, Float64
from genre_tasks.scene.actor_track import ActorTrack
from genre_tasks.scene.chunk import NO_SWEEP, View
from genre_tasks.scene.facade_completion import complete_facades
from genre_tasks.scene.moving_actors import MovingActors, find_points_in_box, select_moving_actors
from genre_tasks.scene.ply_reader import read_ply
from genre_tasks.scene.road_completion import complete_road
from genre_tasks.scene.rotations import quats_to_matrices_numpy
from genre_tasks.scene.transforms import distance_to_path
from genre_tasks.scene.visibility import PointCloud
from genre_tasks.stages.chunk_reading import ChunkReading
from genre_tasks.stages.ingest_views import REMEDY

EGO_BOX_M = (2.6, 1.3, 2.6)
"""Half length, width and height, about the LiDAR pose, of what is the ego vehicle itself and its sensors. Some logs
put that pose on the road, others at the sensor: the height covers both."""

NEAR_PATH_M = 100.0
"""What is farther from the path is left to the distant region, unless ``initial.max_range_m`` says otherwise."""

# Fewer points than these (the smaller counts) are chance: a file in millimetres has some near its origin.
_MIN_NEAR_POINTS = 100
_MIN_NEAR_PART = 0.01
# Points that spread farther about their middle are in a smaller unit; a chunk's surroundings have some hundred metres.
_MAX_SPREAD_M = 5000.0

FramePoints = tuple[int, Float32]
"""A log frame and points [P, 3]."""


@dataclass(frozen=True)
class ChunkPoints:
    """Points of a chunk, not coloured yet.

    Attributes:
        background: points of what stands still.
        actors: points of each moving actor, in its box's coordinates.
        background_colors: [P, 3] the background's colours, where its file has any.
    """

    background: PointCloud
    actors: list[PointCloud]
    background_colors: NDArray[np.uint8] | None = None


def read_points_from_file(reading: ChunkReading, file: str) -> ChunkPoints:
    """Reads the points of a log without LiDAR.

    Args:
        reading: the chunk; actors, which a file has no points for, are noted in its issues.
        file: PLY in the coordinates that ``placement`` takes to the world.

    Returns:
        A background without actors.

    Raises:
        InputError: the file cannot be read, or next to none of its points lie near the path.
    """
    positions, colors = read_ply(file)
    positions = place_points(positions, reading.config.placement)
    # Subtracted in float64, as sweeps are.
    local = (positions - reading.world_SE3_chunk[:3, 3]).astype(np.float32)
    _require_points_near_path(reading, local, file)
    for track in _select_actors(reading).tracks:
        reading.add_issue("actor_few_points", f"track {track.track_id}: points come from a file")
    return ChunkPoints(PointCloud(local, np.full(len(local), NO_SWEEP, np.int16)), [], colors)


def _require_points_near_path(reading: ChunkReading, local: Float32, file: str) -> None:
    """Raises where a file's points [P, 3] in chunk coordinates are not those of this path."""
    distances = distance_to_path(local, reading.chunk_SE3_ego)
    near = int((distances < NEAR_PATH_M).sum())
    if near >= min(_MIN_NEAR_POINTS, _MIN_NEAR_PART * len(local)):
        return
    middle = np.median(local, axis=0)
    spread_m = float(np.median(np.linalg.norm(local - middle, axis=1)))
    offset = ", ".join(f"{value:.0f}" for value in middle)
    reason = f"an offset: their middle lies at ({offset}) m from that of the path"
    if spread_m > _MAX_SPREAD_M:
        reason = f"another unit: they spread over {spread_m:.3g} m about their middle"
    raise InputError(
        f"{near} of {len(local)} points lie within {NEAR_PATH_M:g} m of the path, the median distance is "
        f"{float(np.median(distances)):.4g} m; the likely reason is {reason}",
        remedy="Set ingest.placement.scale to the metres a unit of the file has, or ingest.placement.quat to its "
        "rotation; write the points with the origin of the camera poses, since placement has no offset.",
        file=file,
        log=reading.log.name,
        chunk=reading.chunk,
    )


def place_points(positions: Float64, placement: FilePlacement) -> Float64:
    """Takes points of a file to the log's world.

    Args:
        positions: [P, 3] in the file's axes and unit.
        placement: where they belong.

    Returns:
        [P, 3] metres; the same bits where the placement changes nothing.

    >>> place_points(np.array([[0.0, 0.0, 1.0]]), FilePlacement(scale=2.0)).tolist()
    [[0.0, 0.0, 2.0]]
    """
    if placement == FilePlacement():
        return positions
    rotation = quats_to_matrices_numpy(np.array(placement.quat))
    return placement.scale * (positions @ rotation.T)


def read_points_from_sweeps(reading: ChunkReading, sources: Sequence[View]) -> ChunkPoints:
    """Reads the chunk's LiDAR sweeps, and completes road and façades.

    Args:
        reading: the chunk; its issues grow.
        sources: the source views, which façades are completed by.

    Returns:
        Background and actors; actors with too few points or frames are left out.

    Raises:
        InputError: the chunk has no sweep with points, a pose is far away, or under ``strict`` a sweep is missing or
            unreadable.
    """
    moving = _select_actors(reading)
    background: list[FramePoints] = []
    points_of_track: list[list[FramePoints]] = [[] for _ in moving.tracks]
    for n, frame in enumerate(reading.frames):
        reading.report(len(reading.frames) + n, "sweeps")
        points = _read_sweep(reading, frame)
        if points is None:
            continue
        # Returns from the vehicle itself would become a Gaussian vehicle at every frame of the path.
        points = _remove_ego(points, reading.chunk_SE3_ego[n])
        unassigned = np.ones(len(points), dtype=bool)
        # Points of brief tracks belong neither to an actor nor to the background.
        for k, track in enumerate((*moving.tracks, *moving.brief_tracks)):
            index, in_box = find_points_in_box(points, track, frame)
            # Where boxes overlap the first track takes the points: one point must not be in two nodes.
            newly_assigned = unassigned[index]
            unassigned[index] = False
            if k < len(points_of_track) and newly_assigned.any():
                points_of_track[k].append((frame, in_box[newly_assigned]))
        background.append((frame, points[unassigned]))
    if not any(len(points) for _, points in background):
        raise _describe_no_points(reading, has_sweeps=bool(background))
    # Completion looks at measured points alone; road points that it adds do not take part in completing façades.
    swept = np.concatenate([points for _, points in background])
    try:
        road = complete_road(swept, reading.chunk_SE3_ego)
    except InputError as error:
        raise reading.explain_long_path(error) from error
    background.append((NO_SWEEP, road))
    if reading.config.complete_facades:
        background.append((NO_SWEEP, complete_facades(swept, reading.chunk_SE3_ego, sources)))
    return ChunkPoints(_join(background, None), _build_actor_clouds(reading, moving.tracks, points_of_track))


def _describe_no_points(reading: ChunkReading, has_sweeps: bool) -> InputError:
    """The error for a chunk without points, with the first reason that was noted."""
    remedy = "Give points by ingest.points=FILE.ply, or choose other chunks with --chunks."
    unreadable = [issue for issue in reading.log_issues if issue.kind == "unreadable_sweep"]
    unread = [issue for issue in reading.log_issues if issue.kind == "unread_files" and " in lidar:" in issue.detail]
    problem = "the chunk has no LiDAR sweep"
    if has_sweeps:
        problem = "the LiDAR sweeps of the chunk have no point that can be used"
    elif unreadable:
        first = unreadable[0]
        problem += f" that can be read; {len(unreadable)} cannot, the first one (frame {first.frame}): {first.detail}"
    elif unread:
        problem += f": {unread[0].detail.removesuffix('.')}"
    return reading.input_error(problem, remedy)


def _select_actors(reading: ChunkReading) -> MovingActors:
    config = reading.config
    moving = select_moving_actors(
        _read_tracks(reading),
        reading.frames,
        reading.world_SE3_chunk,
        config.min_actor_travel_m,
        config.min_actor_frames,
    )
    reading.log_issues.extend(moving.log_issues)
    return moving


def _read_tracks(reading: ChunkReading) -> tuple[CuboidTrack, ...]:
    """The annotated objects of the log; without ``strict``, a log whose annotations cannot be read has none."""
    try:
        return reading.log.tracks()
    except InputError as error:
        if reading.config.strict:
            raise
        reading.add_issue("unreadable_cuboids", error.problem, error.frame)
        return ()


def _build_actor_clouds(
    reading: ChunkReading, tracks: Sequence[ActorTrack], points_of_track: Sequence[list[FramePoints]]
) -> list[PointCloud]:
    """Leaves out, and notes, tracks with too few points or frames."""
    config = reading.config
    clouds = []
    for track, parts in zip(tracks, points_of_track, strict=True):
        count = sum(len(points) for _, points in parts)
        # Too few points make no vehicle, and in the background they would be a smear: they are left out of both.
        if count < config.min_actor_points or len(parts) < config.min_actor_frames:
            detail = f"track {track.track_id}: {count} LiDAR points in {len(parts)} frames"
            reading.add_issue("actor_few_points", detail)
        else:
            clouds.append(_join(parts, track))
    return clouds


def _join(parts: Sequence[FramePoints], track: ActorTrack | None) -> PointCloud:
    # The frame goes with each point: it says when an actor's point was seen, and what a frame's depth term may use.
    counts = [len(points) for _, points in parts]
    frames = np.repeat(np.array([frame for frame, _ in parts], np.int16), counts)
    return PointCloud(np.concatenate([points for _, points in parts]), frames, track)


def _read_sweep(reading: ChunkReading, frame: int) -> Float32 | None:
    """Points [P, 3] of a sweep in chunk coordinates; non-finite returns are dropped."""
    try:
        sweep = reading.log.sweep(frame)
    except InputError as error:
        if reading.config.strict:
            raise
        reading.add_issue("unreadable_sweep", error.problem, frame)
        return None
    if sweep is None:
        if reading.config.strict:
            raise reading.input_error("there is no LiDAR sweep", REMEDY, frame=frame)
        reading.add_issue("missing_sweep", "there is no LiDAR sweep", frame)
        return None
    # World coordinates can be kilometres: they are subtracted in float64, and only then rounded.
    points = (sweep.points_world - reading.world_SE3_chunk[:3, 3]).astype(np.float32)
    # Some sensors mark a missing return by NaN or infinity.
    return points[np.isfinite(points).all(1)]


def _remove_ego(points: Float32, chunk_SE3_ego: Float64) -> Float32:
    """Leaves out points on the ego vehicle itself."""
    local = (points - chunk_SE3_ego[:3, 3].astype(np.float32)) @ chunk_SE3_ego[:3, :3].astype(np.float32)
    return points[~(np.abs(local) < np.array(EGO_BOX_M, np.float32)).all(1)]
