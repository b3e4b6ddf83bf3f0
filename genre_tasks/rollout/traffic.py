"""The background of one chunk with the traffic of others, so that actors drive on over borders between chunks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float64
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Actor
from genre_tasks.scene.deformation import NODES, Deformation
from genre_tasks.scene.gaussians import Gaussians, map_attributes
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene_edits.chunk_scene import ChunkScene

Track = TypeVar("Track", ActorNode, Actor)


def extend_traffic(chunk_scene: ChunkScene, other: ChunkScene) -> ChunkScene:
    """Gives a chunk's scene the traffic of another chunk's frames.

    An actor of both chunks looks as in ``chunk_scene`` and drives on as in ``other``. One that only ``other`` has is
    added with its Gaussians. Static and distant Gaussians stay those of ``chunk_scene``.

    Args:
        chunk_scene: whose coordinates and surroundings the result has.
        other: a chunk of the same log, with its scene.

    Returns:
        A scene whose actors exist at the frames of both chunks.
    """
    chunk_SE3_other = np.linalg.inv(chunk_scene.chunk.world_SE3_chunk) @ other.chunk.world_SE3_chunk
    known = {actor.track_id for actor in chunk_scene.scene.actors}
    added = [k for k, actor in enumerate(other.scene.actors) if actor.track_id not in known]
    scene = _add_actors(chunk_scene.scene, other.scene, added)
    nodes = _extend_tracks(chunk_scene.scene.actors, other.scene.actors, chunk_SE3_other)
    actors = _extend_tracks(chunk_scene.chunk.actors, other.chunk.actors, chunk_SE3_other)
    removed = _extend_tracks(chunk_scene.removed, other.removed, chunk_SE3_other)
    chunk = replace(chunk_scene.chunk, actors=actors)
    added_shadows = {name: count for name, count in other.shadow_counts.items() if name not in known}
    shadow_counts = {**chunk_scene.shadow_counts, **added_shadows}
    return ChunkScene(chunk, replace(scene, actors=nodes), removed, shadow_counts)


def compose_scene(background: ChunkScene, traffic: ChunkScene) -> ChunkScene:
    """Puts the actors of one chunk in front of the background of another.

    Args:
        background: whose coordinates, static and distant Gaussians the result has; its actors are left out.
        traffic: a chunk of the same log, whose actors the result has.

    Returns:
        A scene; whether it is rendered with anti-aliasing is as in ``background``.
    """
    still = torch.nonzero(background.scene.nodes < FIRST_ACTOR)[:, 0]
    moving = torch.nonzero(traffic.scene.nodes >= FIRST_ACTOR)[:, 0]
    gaussians = map_attributes(
        lambda mine, theirs: torch.cat([mine[still], theirs[moving]]),
        background.scene.gaussians,
        traffic.scene.gaussians,
    )
    chunk_SE3_other = np.linalg.inv(background.chunk.world_SE3_chunk) @ traffic.chunk.world_SE3_chunk
    scene = replace(
        background.scene,
        gaussians=gaussians,
        nodes=torch.cat([background.scene.nodes[still], traffic.scene.nodes[moving]]),
        actors=_extend_tracks((), traffic.scene.actors, chunk_SE3_other),
        # In the boxes of actors, as their Gaussians and harmonics are: no move between chunks changes it.
        deformation=traffic.scene.deformation,
        spherical_harmonics=_join_spherical_harmonics(background.scene, still, traffic.scene, moving),
    )
    actors = _extend_tracks((), traffic.chunk.actors, chunk_SE3_other)
    # What hid the background where it was recorded counts as well.
    removed = _extend_tracks(background.removed, traffic.removed, chunk_SE3_other)
    return ChunkScene(replace(background.chunk, actors=actors), scene, removed, traffic.shadow_counts)


def _extend_tracks(tracks: Sequence[Track], others: Sequence[Track], chunk_SE3_other: Float64) -> tuple[Track, ...]:
    """The tracks, longer by the frames of their namesakes, and after them those of new names."""
    other_by_name = {track.track_id: track for track in others}
    names = {track.track_id for track in tracks}
    extended = [_extend_track(track, other_by_name.get(track.track_id), chunk_SE3_other) for track in tracks]
    extended += [
        replace(track, chunk_SE3_box=chunk_SE3_other @ track.chunk_SE3_box)
        for track in others
        if track.track_id not in names
    ]
    return tuple(extended)


def _extend_track(track: Track, other: Track | None, chunk_SE3_other: Float64) -> Track:
    if other is None:
        return track
    # Where both chunks have a frame, the chunk whose coordinates these are decides.
    new = ~np.isin(other.frames, track.frames)
    frames = np.concatenate([track.frames, other.frames[new]])
    poses = np.concatenate([track.chunk_SE3_box, chunk_SE3_other @ other.chunk_SE3_box[new]])
    order = np.argsort(frames)
    return replace(track, frames=frames[order], chunk_SE3_box=poses[order])


def _add_actors(scene: SceneGraph, other: SceneGraph, added: Sequence[int]) -> SceneGraph:
    """The scene with the Gaussians of some actors of another one; their nodes follow those that are there."""
    if not added:
        return scene
    number_of = {actor: len(scene.actors) + k for k, actor in enumerate(added)}
    chosen = torch.tensor([FIRST_ACTOR + actor for actor in added])
    rows = torch.nonzero(torch.isin(other.nodes, chosen))[:, 0]
    # A table from old to new nodes, as numbers of actors differ between the two scenes.
    table = torch.zeros(FIRST_ACTOR + len(other.actors), dtype=torch.int64)
    for actor, number in number_of.items():
        table[FIRST_ACTOR + actor] = FIRST_ACTOR + number
    gaussians: Gaussians = map_attributes(
        lambda mine, theirs: torch.cat([mine, theirs[rows]]), scene.gaussians, other.gaussians
    )
    return replace(
        scene,
        gaussians=gaussians,
        nodes=torch.cat([scene.nodes, table[other.nodes[rows]]]),
        deformation=_join_deformations(scene.deformation, other.deformation, number_of),
        spherical_harmonics=_join_spherical_harmonics(scene, torch.arange(len(scene)), other, rows),
    )


def _join_spherical_harmonics(scene: SceneGraph, rows: Tensor, other: SceneGraph, other_rows: Tensor) -> Tensor | None:
    """Harmonics of some Gaussians of two scenes, one after the other; ``None`` where neither has any."""
    harmonics = (scene.spherical_harmonics, other.spherical_harmonics)
    counts = [values.shape[1] for values in harmonics if values is not None]
    if not counts:
        return None
    # Zeros for a scene without, or of a lower degree: they change no colour.
    joined = scene.gaussians.means.new_zeros(len(rows) + len(other_rows), max(counts), 3)
    if scene.spherical_harmonics is not None:
        joined[: len(rows), : scene.spherical_harmonics.shape[1]] = scene.spherical_harmonics[rows]
    if other.spherical_harmonics is not None:
        joined[len(rows) :, : other.spherical_harmonics.shape[1]] = other.spherical_harmonics[other_rows]
    return joined


def _join_deformations(
    deformation: Deformation | None, other: Deformation | None, number_of: Mapping[int, int]
) -> Deformation | None:
    """The deformation with that of some actors of another scene.

    Args:
        deformation: of the scene that actors are added to.
        other: of the scene that they come from.
        number_of: their numbers in the joined scene, by those in the other one.
    """
    rows = [] if other is None else [row for row, actor in enumerate(other.actors) if actor in number_of]
    if other is None or not rows:
        return deformation
    parts = [(other, rows, tuple(number_of[other.actors[row]] for row in rows))]
    if deformation is not None:
        parts.insert(0, (deformation, list(range(len(deformation.actors))), deformation.actors))
    frames = tuple(sorted({frame for part, _, _ in parts for frame in part.frames}))
    known = []
    offsets = []
    for part, part_rows, _ in parts:
        # Each actor keeps its frames: at those of the other chunk it has no offsets, and the nearest ones hold.
        columns = [frames.index(frame) for frame in part.frames]
        part_known = np.zeros((len(part_rows), len(frames)), bool)
        part_known[:, columns] = part.known[part_rows]
        part_offsets = part.offsets.new_zeros(len(part_rows), len(frames), NODES, 3)
        part_offsets[:, columns] = part.offsets[part_rows]
        known.append(part_known)
        offsets.append(part_offsets)
    return Deformation(
        actors=tuple(number for _, _, numbers in parts for number in numbers),
        sizes_m=torch.cat([part.sizes_m[part_rows] for part, part_rows, _ in parts]),
        frames=frames,
        known=np.concatenate(known),
        offsets=torch.cat(offsets),
    )
