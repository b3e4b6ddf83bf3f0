"""A track of cuboids, cut to a chunk: where an object is at each of the chunk's frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import CuboidTrack, Float64
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.transforms import interpolate_pose, invert_se3, is_rigid_transform

MOST_GAP_FRAMES = 10
"""So many frames without an annotation are bridged: over longer gaps the object was out of range, or another one."""


@dataclass(frozen=True)
class ActorTrack(ActorNode):
    """A track inside a chunk, before it is known whether it becomes an actor of the scene."""

    @property
    def travel_m(self) -> float:
        """The largest distance between the box's centre and where it was first."""
        centres = self.chunk_SE3_box[:, :3, 3]
        return float(np.linalg.norm(centres - centres[0], axis=1).max())


@dataclass(frozen=True)
class ValidAnnotations:
    """A track's annotations that are rigid poses, in the order of their frames.

    Attributes:
        frames: [A] frames, rising.
        world_SE3_box: [A, 4, 4].
        invalid: how many annotations were left out.
    """

    frames: NDArray[np.int64]
    world_SE3_box: Float64
    invalid: int

    @classmethod
    def from_track(cls, track: CuboidTrack) -> ValidAnnotations:
        """Selects a track's valid annotations.

        Args:
            track: of a log.
        """
        valid = np.array([is_rigid_transform(pose) for pose in track.world_SE3_box], dtype=bool)
        # A frame that is annotated twice counts once, by its first cuboid.
        frames, first = np.unique(track.frames[valid], return_index=True)
        return cls(frames, track.world_SE3_box[valid][first], int((~valid).sum()))

    def find_pose(self, frame: int) -> Float64 | None:
        """Finds where the object is at a frame.

        Frames between two annotated ones are interpolated, over at most :data:`MOST_GAP_FRAMES`.

        Args:
            frame: of the log.

        Returns:
            world_SE3_box [4, 4]; ``None`` in longer gaps, before the first and after the last annotation.
        """
        # Over frame numbers, not timestamps: in some logs timestamps are out of order, frame numbers never are.
        after = int(np.searchsorted(self.frames, frame))
        if after == len(self.frames):
            return None
        high = int(self.frames[after])
        if high == frame:
            return self.world_SE3_box[after]
        if after == 0 or high - int(self.frames[after - 1]) > MOST_GAP_FRAMES + 1:
            return None
        low = int(self.frames[after - 1])
        before_after = self.world_SE3_box[after - 1], self.world_SE3_box[after]
        return interpolate_pose(*before_after, float(frame - low) / float(high - low))


def cut_track_to_chunk(
    track: CuboidTrack, frames: Sequence[int], world_SE3_chunk: Float64
) -> tuple[ActorTrack | None, int]:
    """Cuts a log's track to a chunk's frames and takes it to chunk coordinates.

    Frames between two annotated ones are interpolated, see :meth:`ValidAnnotations.find_pose`. In longer gaps, before
    the first and after the last the object is absent, since poses are never extrapolated.

    Args:
        track: of the log, in world coordinates.
        frames: log frames of the chunk, in order.
        world_SE3_chunk: [4, 4].

    Returns:
        The track, ``None`` if it is in no frame of the chunk or its size is not finite and positive; and how many of
        its annotations were invalid and left out.
    """
    size = np.asarray(track.size_m, dtype=np.float64)
    if not (np.isfinite(size).all() and (size > 0).all()):
        return None, len(track.frames)
    annotations = ValidAnnotations.from_track(track)
    found = [(frame, annotations.find_pose(frame)) for frame in frames]
    inside = [(frame, pose) for frame, pose in found if pose is not None]
    if not inside:
        return None, annotations.invalid
    # Logs are kilometres from their origin; in the chunk poses are small enough for float32.
    chunk_SE3_world = invert_se3(world_SE3_chunk)
    chunk_SE3_box = np.stack([chunk_SE3_world @ pose for _, pose in inside])
    length, width, height = (float(s) for s in size)
    cut = ActorTrack(
        track_id=track.track_id,
        label=track.label,
        size_m=(length, width, height),
        frames=np.asarray([frame for frame, _ in inside], np.int64),
        chunk_SE3_box=chunk_SE3_box,
    )
    return cut, annotations.invalid
