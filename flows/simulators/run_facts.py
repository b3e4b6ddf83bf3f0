"""What a simulator has to know of a run before it asks for images: its rig, times, ego path and actors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flows.simulation.chunk_outlines import drop_measurements
from flows.simulators.image_request import ActorDescription, CameraDescription
from flows.simulators.run_clock import RunClock, read_clock
from genre_tasks.ego_paths.world_actors import list_world_actors
from genre_tasks.lidar_simulation.ego_motion import interpolate_poses
from genre_tasks.logs.types import Float64
from genre_tasks.rollout.rig import estimate_rig
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene_edits.actor_names import name_actors
from genre_tasks.scene_edits.chunk_scene import SceneSource


@dataclass(frozen=True)
class RunFacts:
    """A run as simulators know it.

    Attributes:
        clock: times and log frames.
        world_SE3_ego: [F, 4, 4] at the clock's times.
        cameras: of the rig, by name.
        actors: moving ones, in the order in which they appear.
        names: readable name of each actor, by track id.
        chunks_by_track: numbers of the chunks that have Gaussians of each actor, by track id.
        ego_masks: [H, W] by camera, where the run has them.
    """

    clock: RunClock
    world_SE3_ego: Float64
    cameras: Mapping[str, CameraDescription]
    actors: tuple[ActorDescription, ...]
    names: Mapping[str, str]
    chunks_by_track: Mapping[str, tuple[int, ...]]
    ego_masks: Mapping[str, NDArray[np.bool_]]


def read_run_facts(source: SceneSource, names: Mapping[str, str] | None = None) -> RunFacts:
    """Reads what simulators have to know.

    Args:
        source: the scenes of a run.
        names: readable name of each actor, by track id; ``None``: numbered as those of a recorded run.

    Returns:
        The facts; no scene, image or point stays in memory for them.

    Raises:
        InputError: the images' times do not rise.
    """
    chunks = []
    chunks_by_track: dict[str, tuple[int, ...]] = {}
    # Every chunk once, in order: a source keeps only the last few in memory.
    for number in source.chunk_numbers:
        loaded = source.load(number)
        chunks.append(drop_measurements(loaded.chunk))
        for actor in loaded.scene.actors:
            chunks_by_track[actor.track_id] = (*chunks_by_track.get(actor.track_id, ()), number)
    clock = read_clock(chunks)
    names = name_actors(source) if names is None else names
    # An edited run has names of actors that are gone.
    names = {track_id: name for track_id, name in names.items() if track_id in chunks_by_track}
    ego = _join_ego_poses(chunks, clock)
    actors = []
    for tracked in list_world_actors(chunks):
        if tracked.actor_id in names:
            times_s = np.array([clock.find_time(float(frame)) for frame in tracked.frames])
            actors.append(
                ActorDescription(
                    track_id=tracked.actor_id,
                    name=names[tracked.actor_id],
                    label=tracked.label,
                    size_m=tracked.size_m,
                    times_s=times_s,
                    world_SE3_box=tracked.world_SE3_box,
                )
            )
    return RunFacts(
        clock=clock,
        world_SE3_ego=ego,
        cameras=_describe_cameras(chunks, clock, ego),
        actors=tuple(actors),
        names=names,
        chunks_by_track=chunks_by_track,
        ego_masks=_find_ego_masks(chunks),
    )


def _join_ego_poses(chunks: Sequence[Chunk], clock: RunClock) -> Float64:
    poses: dict[int, Float64] = {}
    for chunk in chunks:
        for frame, pose in zip(chunk.frames, chunk.world_SE3_chunk @ chunk.chunk_SE3_ego, strict=True):
            poses.setdefault(frame, pose)
    return np.stack([poses[int(frame)] for frame in clock.frames])


def _describe_cameras(chunks: Sequence[Chunk], clock: RunClock, world_SE3_ego: Float64) -> dict[str, CameraDescription]:
    """The rig as a simulator needs it: where cameras sit on the vehicle at the moment of their own image."""
    cameras = {}
    for name, times_s in clock.camera_times_s.items():
        # Seconds since 1970 leave few digits for the fractions that poses are interpolated by.
        moments = times_s - clock.times_s[0]
        ego = interpolate_poses(world_SE3_ego, clock.times_s - clock.times_s[0], moments)
        (camera,) = estimate_rig([_with_ego_poses(chunk, name, clock, ego) for chunk in chunks])
        cameras[name] = CameraDescription(name, camera.lens, camera.ego_SE3_camera, camera.readout_s)
    order = chunks[0].camera_names
    return {name: cameras[name] for name in order if name in cameras}


def _with_ego_poses(chunk: Chunk, camera: str, clock: RunClock, world_SE3_ego: Float64) -> Chunk:
    rows = np.searchsorted(clock.frames, np.asarray(chunk.frames, np.float64))
    chunk_SE3_ego = np.linalg.inv(chunk.world_SE3_chunk) @ world_SE3_ego[rows]
    views = tuple(view for view in chunk.views if view.camera == camera)
    return replace(chunk, camera_names=(camera,), views=views, chunk_SE3_ego=chunk_SE3_ego)


def _find_ego_masks(chunks: Sequence[Chunk]) -> dict[str, NDArray[np.bool_]]:
    masks: dict[str, NDArray[np.bool_]] = {}
    for chunk in chunks:
        for view in chunk.views:
            if view.ego_mask is not None:
                masks.setdefault(view.camera, view.ego_mask)
    return masks
