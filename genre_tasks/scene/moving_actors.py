"""Moving objects of a chunk: their paths from cuboid tracks, and their LiDAR points in box coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import CuboidTrack, Float32, Float64
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Mark
from genre_tasks.scene.transforms import interpolate_pose, rigid, se3_inverse

MARGIN_M = 0.15
"""Boxes are enlarged by this to the sides and above before points are cut out: annotations are tight."""

GROUND_M = 0.08
"""The lowest slice of a box stays in the background: it is road, or indistinguishable from it."""


@dataclass(frozen=True)
class Path(ActorNode):
    """A track inside a chunk, before it is known whether it becomes an actor."""

    @property
    def travel_m(self) -> float:
        """The largest distance between the box's centre and where it was first."""
        centres = self.chunk_SE3_box[:, :3, 3]
        return float(np.linalg.norm(centres - centres[0], axis=1).max())


def path_in_chunk(track: CuboidTrack, frames: Sequence[int], world_SE3_chunk: Float64) -> tuple[Path | None, int]:
    """A track's path over the chunk's frames, and how many of its annotations were invalid and left out.

    Frames between two annotated ones are interpolated; before the first and past the last the object is absent: poses
    are never extrapolated. ``None`` if it is in no frame of the chunk, or its size is not finite and positive.
    """
    size = np.asarray(track.size_m, dtype=np.float64)
    if not (np.isfinite(size).all() and (size > 0).all()):
        return None, len(track.frames)
    valid = np.array([rigid(pose) for pose in track.world_SE3_box], dtype=bool)
    annotated, first = np.unique(track.frames[valid], return_index=True)
    poses = track.world_SE3_box[valid][first]
    invalid = int((~valid).sum())
    inside = [f for f in frames if len(annotated) and annotated[0] <= f <= annotated[-1]]
    if not inside:
        return None, invalid
    chunk_SE3_world = se3_inverse(world_SE3_chunk)
    out = np.stack([chunk_SE3_world @ _pose_at(annotated, poses, f) for f in inside])
    length, width, height = (float(s) for s in size)
    return Path(track.track_id, track.label, (length, width, height), np.asarray(inside, np.int64), out), invalid


def _pose_at(annotated: NDArray[np.int64], poses: Float64, frame: int) -> Float64:
    """Interpolated over frame numbers, which are in order also where timestamps are not."""
    after = int(np.searchsorted(annotated, frame))
    if annotated[after] == frame:
        return poses[after]
    low, high = annotated[after - 1], annotated[after]
    return interpolate_pose(poses[after - 1], poses[after], float(frame - low) / float(high - low))


@dataclass(frozen=True)
class Movers:
    """Tracks that move in a chunk: ``kept`` become actors if they gather enough points, ``brief`` are left out.

    ``marks`` says what was ignored.
    """

    kept: tuple[Path, ...]
    brief: tuple[Path, ...]
    marks: tuple[Mark, ...]


def movers(
    tracks: Sequence[CuboidTrack],
    frames: Sequence[int],
    world_SE3_chunk: Float64,
    min_travel_m: float,
    min_frames: int,
) -> Movers:
    """Sorts tracks: outside the chunk (counted), invalid (marked), standing (background: nothing), brief, kept."""
    kept, brief, marks, outside = [], [], [], 0
    for track in tracks:
        path, invalid = path_in_chunk(track, frames, world_SE3_chunk)
        if invalid:
            detail = f"track {track.track_id}: {invalid} of {len(track.frames)} cuboids are invalid and ignored"
            marks.append(Mark("cuboid_invalid", detail))
        if path is None:
            outside += 0 if invalid else 1
        elif len(path.frames) < min_frames and track.moving:
            brief.append(path)
            marks.append(Mark("actor_few_points", f"track {track.track_id}: seen in {len(path.frames)} frames"))
        elif path.travel_m >= min_travel_m:
            kept.append(path)
    if outside:
        marks.append(Mark("cuboid_outside", f"{outside} tracks have no cuboid in this chunk"))
    return Movers(tuple(kept), tuple(brief), tuple(marks))


def inside_box(points: Float32, path: Path, frame: int) -> tuple[NDArray[np.int64], Float32]:
    """Which chunk points [P, 3] lie in a path's box (slightly enlarged) at a frame, and those in box coordinates."""
    pose = path.pose(frame)
    if pose is None:
        return np.empty(0, np.int64), np.empty((0, 3), np.float32)
    length, width, height = path.size_m
    reach = 0.5 * float(np.hypot(np.hypot(length, width), height)) + 2 * MARGIN_M
    centre = pose[:3, 3].astype(np.float32)
    index = np.flatnonzero((np.abs(points - centre) < np.float32(reach)).all(1))
    box = (points[index] - centre) @ pose[:3, :3].astype(np.float32)
    ok = (np.abs(box[:, 0]) < length / 2 + MARGIN_M) & (np.abs(box[:, 1]) < width / 2 + MARGIN_M)
    ok &= (box[:, 2] < height / 2 + MARGIN_M) & (box[:, 2] > -height / 2 + GROUND_M)
    return index[ok], box[ok]
