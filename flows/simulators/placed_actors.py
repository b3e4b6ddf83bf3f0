"""Scenes whose actors are where a simulator wants them during one image."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from flows.simulators.image_request import ActorPose
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64
from genre_tasks.rollout.traffic import extend_traffic
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.transforms import interpolate_pose, invert_se3
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource
from genre_tasks.suggestions import did_you_mean

_SCENES_IN_MEMORY = 2
_SceneKey = tuple[object, ...]
# Actors, and letters of a name, that an error repeats.
_LISTED = 40


@dataclass(frozen=True)
class Readout:
    """The log frames that stand for the readout of one image: its middle and one frame to both sides.

    An actor moves from frame to frame. So a readout of any length becomes two frames of half its length, and the
    renderer turns the difference between the two into a velocity.

    Attributes:
        frame: log frame nearest to the middle.
        readout_s: seconds; 0: all rows at once.
    """

    frame: int
    readout_s: float

    @property
    def frames(self) -> Float64:
        """Start, middle and end of the readout; the middle alone where all rows are read at once."""
        steps = np.array([-1.0, 0.0, 1.0]) if self.readout_s else np.zeros(1)
        return self.frame + steps


class ActorPlacer:
    """Puts the actors of a run where a simulator wants them.

    Args:
        source: the scenes of the run.
        chunks_by_track: numbers of the chunks that have Gaussians of each actor, by track id.
        names: readable name of each actor, by track id.
    """

    def __init__(
        self, source: SceneSource, chunks_by_track: Mapping[str, Sequence[int]], names: Mapping[str, str]
    ) -> None:
        self._source = source
        self._chunks_by_track = chunks_by_track
        self._names = names
        self._track_by_name = {name: track_id for track_id, name in names.items()}
        # The latest scenes with actors of other chunks, because joining copies Gaussians and reads those chunks.
        self._extended: dict[_SceneKey, ChunkScene] = {}

    def resolve(self, words: Sequence[str]) -> tuple[str, ...]:
        """Finds which actors are meant.

        Args:
            words: the log's track ids, or readable names.

        Returns:
            The track id of each.

        Raises:
            InputError: an actor is not known, or is there twice.
        """
        found: list[str] = []
        for word in words:
            track_id = self._find(word)
            if track_id in found:
                raise InputError(
                    f"actor {self._names[track_id]} ({track_id!r}) is there twice", remedy="Name each actor once."
                )
            found.append(track_id)
        return tuple(found)

    def _find(self, word: str) -> str:
        # The log's own id first: the readable name of another actor may look the same. Nothing shorter counts, as an
        # actor of the simulator's own would else be taken for one of the log.
        if word in self._names:
            return word
        if word in self._track_by_name:
            return self._track_by_name[word]
        known = [*self._track_by_name, *self._names]
        shown = ", ".join(list(self._track_by_name)[:_LISTED]) or "none"
        raise InputError(
            f"the run has no actor {word[:_LISTED]!r}", remedy=f"{did_you_mean(word[:_LISTED], known)}It has {shown}."
        )

    def gather(self, chunk_scene: ChunkScene, track_ids: Sequence[str]) -> ChunkScene:
        """Gives a scene the Gaussians of actors that only other chunks have.

        Args:
            chunk_scene: that shows the moment.
            track_ids: of all actors that are wanted.

        Returns:
            The scene itself where it has them all.
        """
        known = {actor.track_id for actor in chunk_scene.scene.actors}
        # The nearest chunk has seen the actor from a place that is most like this one.
        others = {
            min(self._chunks_by_track[track_id], key=lambda number: abs(number - chunk_scene.chunk.index))
            for track_id in track_ids
            if track_id not in known
        }
        if not others:
            return chunk_scene
        numbers = tuple(sorted(others))
        key = (*_describe_scene(chunk_scene), numbers)
        extended = self._extended.pop(key, None)
        if extended is None:
            extended = chunk_scene
            for number in numbers:
                extended = extend_traffic(extended, self._source.load(number))
        # The latest last, so that the oldest one makes room.
        self._extended[key] = extended
        while len(self._extended) > _SCENES_IN_MEMORY:
            del self._extended[next(iter(self._extended))]
        return extended


def _describe_scene(chunk_scene: ChunkScene) -> _SceneKey:
    """What tells a scene from the others of its run, by value: sources read a scene anew once they have dropped it.

    Scenes of one background differ by the chunk whose actors they show, and so by how many Gaussians those have.
    """
    counts = torch.bincount(chunk_scene.scene.nodes).tolist()
    tracks = tuple((actor.track_id, tuple(actor.frames.tolist())) for actor in chunk_scene.scene.actors)
    return chunk_scene.chunk.index, tracks, tuple(counts)


def place_actors(
    chunk_scene: ChunkScene, actors: Mapping[str, ActorPose], readout: Readout, recorded: Collection[str] = ()
) -> SceneGraph:
    """Puts exactly some actors into a scene.

    Args:
        chunk_scene: that has Gaussians of them all.
        actors: their poses, by track id; all others are absent, except for those of ``recorded``.
        readout: of the image.
        recorded: track ids of actors that stay where they were recorded.

    Returns:
        A scene to be rendered at the log frame of the readout, or with recorded actors at its very moment. It shares
        its Gaussians with ``chunk_scene``.
    """
    chunk_SE3_world = invert_se3(chunk_scene.chunk.world_SE3_chunk)
    nodes = []
    for node in chunk_scene.scene.actors:
        wanted = actors.get(node.track_id)
        if wanted is None and node.track_id in recorded:
            nodes.append(node)
            continue
        if wanted is None:
            nodes.append(replace(node, frames=np.zeros(0, np.int64), chunk_SE3_box=np.zeros((0, 4, 4))))
            continue
        start = chunk_SE3_world @ wanted.start_world_SE3_box
        end = chunk_SE3_world @ wanted.end_world_SE3_box
        middle = interpolate_pose(start, end, 0.5)
        poses = np.stack([start, middle, end]) if readout.readout_s else middle[None]
        nodes.append(_move_node(node, readout, poses))
    return replace(chunk_scene.scene, actors=tuple(nodes))


def _move_node(node: ActorNode, readout: Readout, poses: Float64) -> ActorNode:
    return replace(node, frames=np.rint(readout.frames).astype(np.int64), chunk_SE3_box=poses)
