"""Actors of a run in the log's world, over all of its chunks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import CuboidTrack, Float64
from genre_tasks.scene.chunk import Chunk


@dataclass(frozen=True)
class BoxesInPlane:
    """Boxes seen from above, one for each pose of a path.

    Attributes:
        center_m: [P, 2] world x and y.
        heading_rad: [P] of the box's x axis.
        bottom_m: [P] world z of the lower side.
        top_m: [P] world z of the upper side.
        exists: [P] the actor is there.
    """

    center_m: Float64
    heading_rad: Float64
    bottom_m: Float64
    top_m: Float64
    exists: NDArray[np.bool_]


@dataclass(frozen=True)
class WorldActor:
    """An actor's box through the log.

    Attributes:
        actor_id: the log's name for the object, or that of an edit.
        label: its class, in the log's words.
        size_m: length, width and height.
        frames: [F] log frames at which it exists, rising.
        world_SE3_box: [F, 4, 4] with the origin at the centre.
    """

    actor_id: str
    label: str
    size_m: tuple[float, float, float]
    frames: NDArray[np.int64]
    world_SE3_box: Float64

    def place_boxes(self, frames: Float64) -> BoxesInPlane:
        """Places the box at moments of the log, as renders do: where the motion leads from the nearest frame.

        Args:
            frames: [P] log frames, or moments between them.

        Returns:
            A box for each; of moments at which the actor does not exist the numbers mean nothing.
        """
        nearest = np.rint(frames).astype(np.int64)
        index = np.clip(np.searchsorted(self.frames, nearest), 0, len(self.frames) - 1)
        before = np.maximum(index - 1, 0)
        after = np.minimum(index + 1, len(self.frames) - 1)
        # Across a gap there is no motion, see ``ActorNode.motion``.
        first = np.where(self.frames[before] == nearest - 1, before, index)
        last = np.where(self.frames[after] == nearest + 1, after, index)
        span = np.maximum(self.frames[last] - self.frames[first], 1)
        center = self.world_SE3_box[:, :3, 3]
        heading = np.unwrap(np.arctan2(self.world_SE3_box[:, 1, 0], self.world_SE3_box[:, 0, 0]))
        fraction = frames - nearest
        rate = fraction / span
        placed = center[index] + rate[:, None] * (center[last] - center[first])
        return BoxesInPlane(
            center_m=placed[:, :2],
            heading_rad=heading[index] + rate * (heading[last] - heading[first]),
            bottom_m=placed[:, 2] - 0.5 * self.size_m[2],
            top_m=placed[:, 2] + 0.5 * self.size_m[2],
            exists=self.frames[index] == nearest,
        )


def list_world_actors(chunks: Iterable[Chunk]) -> tuple[WorldActor, ...]:
    """Lists the moving actors of chunks; one that several chunks have is one actor.

    Args:
        chunks: of one log, with edits applied if there are any. They are read one after the other.

    Returns:
        The actors in the order in which they appear. Parked ones belong to the background: see ``list_parked_actors``.
    """
    parts: dict[str, list[WorldActor]] = {}
    for chunk in chunks:
        for actor in chunk.actors:
            boxes = chunk.world_SE3_chunk @ actor.chunk_SE3_box
            part = WorldActor(actor.track_id, actor.label, actor.size_m, actor.frames, boxes)
            parts.setdefault(actor.track_id, []).append(part)
    return tuple(_join_parts(list_of_parts) for list_of_parts in parts.values() if len(list_of_parts[0].frames))


def list_parked_actors(tracks: Sequence[CuboidTrack], chunks: Iterable[Chunk]) -> tuple[WorldActor, ...]:
    """Lists the annotated objects that stand still: reconstruction takes them for background.

    Args:
        tracks: of the log.
        chunks: as they were reconstructed, without edits: an actor of a chunk is no background there.

    Returns:
        The tracks at those frames of the chunks at which they are background.
    """
    background_frames: dict[str, set[int]] = {track.track_id: set() for track in tracks}
    for chunk in chunks:
        moving = {actor.track_id for actor in chunk.actors}
        for track_id, frames in background_frames.items():
            if track_id not in moving:
                frames.update(chunk.frames)
    parked = []
    for track in tracks:
        wanted = np.isin(track.frames, sorted(background_frames[track.track_id]))
        sound = np.isfinite(track.world_SE3_box).all(axis=(1, 2)) & (min(track.size_m) > 0)
        chosen = wanted & sound
        if chosen.any():
            actor = WorldActor(
                track.track_id, track.label, track.size_m, track.frames[chosen], track.world_SE3_box[chosen]
            )
            parked.append(actor)
    return tuple(parked)


def _join_parts(parts: Sequence[WorldActor]) -> WorldActor:
    frames = np.concatenate([part.frames for part in parts])
    boxes = np.concatenate([part.world_SE3_box for part in parts])
    # A frame that two chunks share counts once.
    unique, index = np.unique(frames, return_index=True)
    first = parts[0]
    return WorldActor(first.actor_id, first.label, first.size_m, unique, boxes[index])
