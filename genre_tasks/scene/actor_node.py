"""An actor of the scene graph: where its box is at each log frame, and how it moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.logs.types import Float64


@dataclass(frozen=True)
class ActorNode:
    """An actor's box and its path through a chunk.

    Attributes:
        track_id: the log's name for the object.
        label: its class, in the log's words.
        size_m: length, width and height of its box.
        frames: [F] log frames at which it exists, in rising order.
        chunk_SE3_box: [F, 4, 4] float64, its pose at each of them.
    """

    track_id: str
    label: str
    size_m: tuple[float, float, float]
    frames: NDArray[np.int64]
    chunk_SE3_box: Float64

    def pose(self, frame: float) -> Float64 | None:
        """Gives the box's pose at a log frame or at a moment between frames.

        Args:
            frame: log frame; between two frames the pose is where the motion leads from the nearest one.

        Returns:
            [4, 4], or ``None`` where the actor does not exist.

        >>> car = ActorNode("7", "car", (4.5, 1.8, 1.5), np.array([3]), np.eye(4)[None])
        >>> car.pose(3).shape, car.pose(4) is None
        ((4, 4), True)
        """
        index = np.flatnonzero(self.frames == round(frame))
        if not len(index):
            return None
        pose = self.chunk_SE3_box[index[0]]
        fraction = frame - round(frame)
        if not fraction:
            return pose
        # Not interpolated between two poses: a rolling shutter and motion blur move actors by these rates, and both
        # must agree with where the actor is.
        velocity, turn = self.motion(frame)
        moved = pose.copy()
        moved[:3, :3] = Rotation.from_rotvec(fraction * turn).as_matrix() @ pose[:3, :3]
        moved[:3, 3] += fraction * velocity
        return moved

    def motion(self, frame: float) -> tuple[Float64, Float64]:
        """Gives velocity and turn rate at a log frame, from the poses before and after.

        At an end of the path the pose there takes the place of the missing one. An end is also where the frame before
        or after is missing: a gap tells nothing of the motion. Between frames the motion is that at the nearest frame.

        Args:
            frame: log frame.

        Returns:
            Velocity of the centre [3] in metres a frame and rotation vector [3] in radians a frame, both in chunk axes;
            zero where the actor does not exist or has no pose at a frame next to this one.
        """
        index = np.flatnonzero(self.frames == round(frame))
        if not len(index):
            return np.zeros(3), np.zeros(3)
        # Central differences: annotations jitter, and a difference over two frames halves that.
        # Across a gap they would spread what may be a leap, or another object's path, over its frames.
        has_before = np.isin(round(frame) - 1, self.frames)
        has_after = np.isin(round(frame) + 1, self.frames)
        first = index[0] - int(has_before)
        last = index[0] + int(has_after)
        span = max(last - first, 1)
        before = self.chunk_SE3_box[first]
        after = self.chunk_SE3_box[last]
        # As a rotation vector, which divides by the number of frames as a matrix does not.
        turned = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
        return (after[:3, 3] - before[:3, 3]) / span, turned / span
