"""What edits need to know of a run: the tracks of its actors, the ego path and the ground, in world coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.frame_clock import FrameClock
from genre_tasks.ego_paths.recorded_path import ImageTime, list_image_times, measure_frame_times
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import FIRST_ACTOR
from genre_tasks.scene_edits.actor_names import NamedSource, number_tracks
from genre_tasks.scene_edits.chunk_scene import SceneSource
from genre_tasks.scene_edits.ground import Ground, thin_ground_points


@dataclass(frozen=True)
class Track:
    """The path of one actor through all chunks of a run.

    Attributes:
        track_id: the log's name for the object.
        label: its class, in the log's words.
        size_m: length, width and height of its box.
        frames: [F] log frames at which it exists, rising.
        world_SE3_box: [F, 4, 4].
        gaussians: how many Gaussians it has, by number of the chunk.
    """

    track_id: str
    label: str
    size_m: tuple[float, float, float]
    frames: NDArray[np.int64]
    world_SE3_box: Float64
    gaussians: Mapping[int, int]

    @property
    def bottoms(self) -> Float64:
        """[F, 3] the middle of the box's lower face."""
        return np.asarray(
            self.world_SE3_box[:, :3, 3] - self.world_SE3_box[:, :3, 2] * (self.size_m[2] / 2), np.float64
        )


@dataclass(frozen=True)
class RunSurvey:
    """The traffic of a run.

    Attributes:
        tracks: of all actors, by track id.
        names: readable name by track id.
        path: the recorded path of the ego vehicle.
        ground: height of the ground.
    """

    tracks: Mapping[str, Track]
    names: Mapping[str, str]
    path: EgoPath
    ground: Ground

    @cached_property
    def clock(self) -> FrameClock:
        """The times of all log frames of the run."""
        return FrameClock.from_path(self.path)


@dataclass
class _Gathered:
    label: str
    size_m: tuple[float, float, float]
    poses: dict[int, Float64] = field(default_factory=dict)
    gaussians: dict[int, int] = field(default_factory=dict)


def survey_run(source: SceneSource) -> RunSurvey:
    """Looks through the chunks of a run, one after the other, so that the memory it takes does not grow with them.

    Args:
        source: the scenes of the run.

    Returns:
        Tracks, names, path and ground.
    """
    gathered: dict[str, _Gathered] = {}
    ego: list[tuple[NDArray[np.float64], Float64]] = []
    points: list[Float64] = []
    images: list[ImageTime] = []
    for number in source.chunk_numbers:
        chunk_scene = source.load(number)
        chunk = chunk_scene.chunk
        ego.append((np.asarray(chunk.frames, np.float64), chunk.world_SE3_chunk @ chunk.chunk_SE3_ego))
        points.append(_ground_points(chunk))
        images += list_image_times(chunk)
        counts = torch.bincount(chunk_scene.scene.nodes, minlength=FIRST_ACTOR + len(chunk_scene.scene.actors))
        for k, actor in enumerate(chunk_scene.scene.actors):
            entry = gathered.setdefault(actor.track_id, _Gathered(actor.label, actor.size_m))
            entry.gaussians[number] = int(counts[FIRST_ACTOR + k])
            for frame, pose in zip(actor.frames, chunk.world_SE3_chunk @ actor.chunk_SE3_box, strict=True):
                entry.poses.setdefault(int(frame), pose)
    tracks = {track_id: _make_track(track_id, entry) for track_id, entry in gathered.items()}
    path = _join_path(ego, images)
    if isinstance(source, NamedSource):
        names = {track_id: name for track_id, name in source.names.items() if track_id in tracks}
    else:
        names = number_tracks((int(t.frames[0]), t.track_id, t.label) for t in tracks.values())
    ground = Ground.from_points(np.concatenate(points), path, [track.bottoms for track in tracks.values()])
    return RunSurvey(tracks, names, path, ground)


def _ground_points(chunk: Chunk) -> Float64:
    rotation = chunk.world_SE3_chunk[:3, :3]
    world = chunk.static.positions.astype(np.float64) @ rotation.T + chunk.world_SE3_chunk[:3, 3]
    return thin_ground_points(world)


def _make_track(track_id: str, entry: _Gathered) -> Track:
    frames = np.array(sorted(entry.poses), np.int64)
    poses = np.stack([entry.poses[int(frame)] for frame in frames])
    return Track(track_id, entry.label, entry.size_m, frames, poses, entry.gaussians)


def _join_path(ego: Sequence[tuple[NDArray[np.float64], Float64]], images: Sequence[ImageTime]) -> EgoPath:
    frames = np.concatenate([f for f, _ in ego])
    return EgoPath(measure_frame_times(frames, images), frames, np.concatenate([poses for _, poses in ego]))
