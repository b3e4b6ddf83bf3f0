"""An actor's path through a chunk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import Float64


@dataclass(frozen=True)
class ActorNode:
    """An actor's path: ``frames`` [F] log frames, ``chunk_SE3_box`` [F, 4, 4] float64."""

    track_id: str
    label: str
    size_m: tuple[float, float, float]
    frames: NDArray[np.int64]
    chunk_SE3_box: Float64

    def pose(self, frame: float) -> Float64 | None:
        """[4, 4] at a log frame, or ``None`` where the actor does not exist.

        Between frames: where its motion brings it from the nearest one.
        """
        at = np.flatnonzero(self.frames == round(frame))
        if not len(at):
            return None
        pose, part = self.chunk_SE3_box[at[0]], frame - round(frame)
        if not part:
            return pose
        velocity, turn = self.motion(frame)
        moved = pose.copy()
        moved[:3, :3] = Rotation.from_rotvec(part * turn).as_matrix() @ pose[:3, :3]
        moved[:3, 3] += part * velocity
        return moved

    def motion(self, frame: float) -> tuple[Float64, Float64]:
        """Velocity of the centre [3] and turn [3] at a log frame, in m and rad a frame, in chunk axes.

        From the poses before and after, from its own pose at an end of the path; zero where there is no other one.
        Between frames it is that at the nearest one.
        """
        at = np.flatnonzero(self.frames == round(frame))
        if not len(at):
            return np.zeros(3), np.zeros(3)
        first, last = max(at[0] - 1, 0), min(at[0] + 1, len(self.frames) - 1)
        span = max(int(self.frames[last] - self.frames[first]), 1)
        before, after = self.chunk_SE3_box[first], self.chunk_SE3_box[last]
        turned = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
        return (after[:3, 3] - before[:3, 3]) / span, turned / span
