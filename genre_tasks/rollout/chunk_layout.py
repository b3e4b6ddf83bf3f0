"""How a run's chunks follow each other in the log, and at which place of the recorded path a pose is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.logs.types import Float64
from genre_tasks.scene_edits.chunk_scene import SceneSource

# Recorded poses of a standing vehicle jitter by millimetres: of those the one of the pose's own moment is meant.
_M_PER_FRAME = 0.002
# An actor is posed by the nearest frame, and exposures move it by less than half a frame.
_NEAREST_FRAME = 0.49
# A place that was recorded facing the other way counts as so much farther. Lanes of one street are nearer to each other
# than that, and who turns around where there is no other lane stays there.
_OTHER_WAY_M = 20.0
# Cosine of the least angle at which a vehicle faces the other way. At a right angle, as where a path leaves the
# recorded street, the nearest place is the right one.
_OTHER_WAY_COS = -0.5


@dataclass(frozen=True)
class ChunkLayout:
    """The chunks of a run in the order of the log.

    Attributes:
        numbers: of the N chunks.
        first_frames: [N] first log frame of each chunk.
        last_frames: [N] last log frame of each chunk.
        frames: [F] all log frames.
        positions: [F, 2] of the recorded vehicle in the ground plane of the log's world, metres.
        facings: [F, 2] where it faces, in the same plane; unit vectors where it is level.
    """

    numbers: tuple[int, ...]
    first_frames: tuple[int, ...]
    last_frames: tuple[int, ...]
    frames: Float64
    positions: Float64
    facings: Float64

    def find_traffic(self, frame: float) -> tuple[int, ...]:
        """Finds the chunks whose actors exist at a moment.

        Args:
            frame: log frame, or a moment between two.

        Returns:
            One number; two in the middle between the frames of two chunks.
        """
        found = []
        for moment in (frame - _NEAREST_FRAME, frame + _NEAREST_FRAME):
            # Of the last chunk that has begun by then.
            index = max(int(np.searchsorted(self.first_frames, round(moment), side="right")) - 1, 0)
            found.append(self.numbers[index])
        return tuple(dict.fromkeys(found))

    def find_places(self, path: EgoPath) -> Float64:
        """Finds when the recorded vehicle was where a path is: a braking vehicle stays at places of earlier frames.

        Args:
            path: P poses.

        Returns:
            [P] log frames, or moments between them: see :meth:`find_place`.
        """
        poses = path.world_SE3_ego
        placed = zip(poses[:, :2, 3], path.frames, poses[:, :2, 0], strict=True)
        return np.array([self.find_place(position, float(frame), facing) for position, frame, facing in placed])

    def find_place(self, position: Float64, frame: float, facing: Float64 | None) -> float:
        """Finds when the recorded vehicle was at a place.

        Args:
            position: [2] in the ground plane of the log's world, metres.
            frame: log frame of the moment.
            facing: [2] where the vehicle faces, of any length; ``None``: not known.

        Returns:
            A log frame, or a moment between two. Of several the one nearest to ``frame``, and rather one at which the
            recorded vehicle did not face the other way: on a log with a U-turn that is the other lane.
        """
        start = self.positions[:-1]
        step = self.positions[1:] - start
        if not len(step):
            return float(self.frames[0])
        squared_length = np.maximum((step**2).sum(1), 1e-12)
        offset = position - start
        fraction = np.clip((offset * step).sum(1) / squared_length, 0, 1)
        distance = np.linalg.norm(offset - fraction[:, None] * step, axis=1)
        # The recorded poses too: while the vehicle stands, the way between two of them has no direction.
        distance = np.append(distance, np.linalg.norm(position - self.positions, axis=1))
        moments = np.append(self.frames[:-1] + fraction * np.diff(self.frames), self.frames)
        cost = distance + _M_PER_FRAME * np.abs(moments - frame)
        if facing is not None:
            # By where the vehicle faces, which standing and reversing do not change as they do the direction driven.
            lengths = np.linalg.norm(self.facings, axis=1) * np.linalg.norm(facing)
            turned = self.facings @ facing < _OTHER_WAY_COS * lengths
            cost[np.append(turned[:-1] | turned[1:], turned)] += _OTHER_WAY_M
        return float(moments[cost.argmin()])


def lay_out_chunks(source: SceneSource) -> ChunkLayout:
    """Reads where the chunks of a run are in the log.

    Args:
        source: the scenes of a run.

    Returns:
        The layout; no chunk stays in memory for it.
    """
    firsts = []
    lasts = []
    frames = []
    positions = []
    facings = []
    # Every chunk once, in order: a source keeps only the last few in memory.
    for number in source.chunk_numbers:
        chunk = source.load(number).chunk
        firsts.append(chunk.frames[0])
        lasts.append(chunk.frames[-1])
        frames.append(np.asarray(chunk.frames, np.float64))
        world_SE3_ego = chunk.world_SE3_chunk @ chunk.chunk_SE3_ego
        positions.append(world_SE3_ego[:, :2, 3])
        facings.append(world_SE3_ego[:, :2, 0])
    return ChunkLayout(
        numbers=tuple(source.chunk_numbers),
        first_frames=tuple(firsts),
        last_frames=tuple(lasts),
        frames=np.concatenate(frames),
        positions=np.concatenate(positions),
        facings=np.concatenate(facings),
    )
