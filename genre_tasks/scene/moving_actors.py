"""Moving objects of a chunk: which cuboid tracks become actors, and which LiDAR points are theirs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import CuboidTrack, Float32, Float64
from genre_tasks.scene.actor_track import ActorTrack, cut_track_to_chunk
from genre_tasks.scene.chunk import LogIssue

MARGIN_M = 0.15
"""Boxes are enlarged by this to the sides and above before points are cut out: annotations are tight."""

GROUND_M = 0.08
"""The lowest slice of a box stays in the background: it is road, or indistinguishable from it."""


@dataclass(frozen=True)
class MovingActors:
    """Tracks that move in a chunk.

    Attributes:
        tracks: become actors if they gather enough LiDAR points.
        brief_tracks: move, but are in too few frames: their points belong neither to an actor nor to the background.
        log_issues: what was ignored, and why.
    """

    tracks: tuple[ActorTrack, ...]
    brief_tracks: tuple[ActorTrack, ...]
    log_issues: tuple[LogIssue, ...]


def select_moving_actors(
    tracks: Sequence[CuboidTrack],
    frames: Sequence[int],
    world_SE3_chunk: Float64,
    min_travel_m: float,
    min_frames: int,
) -> MovingActors:
    """Finds the tracks of a log that move in a chunk; those that stand still belong to the background.

    Args:
        tracks: of the log, in world coordinates.
        frames: log frames of the chunk, in order.
        world_SE3_chunk: [4, 4].
        min_travel_m: a track that travels less stands still.
        min_frames: a track that is in fewer frames, and that the log says is moving, is brief.

    Returns:
        The moving tracks, and an issue for each track that has invalid cuboids, is brief, or lies outside the chunk.
    """
    moving = []
    brief = []
    issues = []
    outside = 0
    for log_track in tracks:
        track, invalid = cut_track_to_chunk(log_track, frames, world_SE3_chunk)
        if invalid:
            detail = f"track {log_track.track_id}: {invalid} of {len(log_track.frames)} cuboids are invalid and ignored"
            issues.append(LogIssue("cuboid_invalid", detail))
        if track is None:
            # A track whose cuboids were invalid has an issue already.
            outside += 0 if invalid else 1
        # What moves but is seen too briefly to be modelled would leave a ghost in the background.
        elif len(track.frames) < min_frames and log_track.moving:
            brief.append(track)
            issues.append(
                LogIssue("actor_few_points", f"track {log_track.track_id}: seen in {len(track.frames)} frames")
            )
        elif track.travel_m >= min_travel_m:
            moving.append(track)
    if outside:
        issues.append(LogIssue("cuboid_outside", f"{outside} tracks have no cuboid in this chunk"))
    return MovingActors(tuple(moving), tuple(brief), tuple(issues))


def find_points_in_box(points: Float32, track: ActorTrack, frame: int) -> tuple[NDArray[np.int64], Float32]:
    """Finds the points in a track's box at a frame; the box is enlarged by ``MARGIN_M`` and cut at ``GROUND_M``.

    Args:
        points: [P, 3] metres, chunk coordinates.
        track: whose box.
        frame: log frame.

    Returns:
        Indices [M] into ``points``, and those points [M, 3] in box coordinates; both empty where the track is absent.
    """
    pose = track.pose(frame)
    # Poses are not extrapolated: where a track ends is where its annotation ended.
    if pose is None:
        return np.empty(0, np.int64), np.empty((0, 3), np.float32)
    length, width, height = track.size_m
    # A cube about the centre first: it costs no rotation and leaves out all but a few of a sweep's points.
    reach = 0.5 * float(np.hypot(np.hypot(length, width), height)) + 2 * MARGIN_M
    centre = pose[:3, 3].astype(np.float32)
    index = np.flatnonzero((np.abs(points - centre) < np.float32(reach)).all(1))
    box = (points[index] - centre) @ pose[:3, :3].astype(np.float32)
    inside = (np.abs(box[:, 0]) < length / 2 + MARGIN_M) & (np.abs(box[:, 1]) < width / 2 + MARGIN_M)
    # Below, the box is cut and not enlarged: a slice of road would otherwise drive along with the car.
    inside &= (box[:, 2] < height / 2 + MARGIN_M) & (box[:, 2] > -height / 2 + GROUND_M)
    return index[inside], box[inside]
