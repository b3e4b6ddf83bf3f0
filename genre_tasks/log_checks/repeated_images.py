"""Cameras that hang: the same file again and again, while the vehicle moves."""

from __future__ import annotations

import hashlib
from itertools import groupby

import numpy as np

from genre_tasks.logs.findings import Finding, format_frames
from genre_tasks.logs.types import Float64

# A frame's travel in walking pace; a vehicle that stands may send equal images of a synthetic street.
_MIN_MOTION_M = 0.3


class ImageRecord:
    """What is remembered of a camera's images: their digests, and where each was taken.

    >>> record = ImageRecord("front")
    >>> for frame in range(3):
    ...     pose = np.eye(4)
    ...     pose[0, 3] = frame
    ...     record.add(frame, b"the same", pose)
    >>> record.find_repeated().message
    'front: the images of frames 0–2 repeat one another, while the camera moves by 2.0 m'

    Args:
        camera: name of the camera.
    """

    def __init__(self, camera: str) -> None:
        self._camera = camera
        self._images: list[tuple[int, bytes, Float64]] = []

    def add(self, frame: int, data: bytes, world_SE3_camera: Float64) -> None:
        """Remembers an image.

        Args:
            frame: log frame, larger than those before.
            data: the encoded file, of which a digest stays in memory.
            world_SE3_camera: [4, 4] where it was taken.
        """
        digest = hashlib.blake2b(data, digest_size=16).digest()
        self._images.append((frame, digest, world_SE3_camera[:3, 3].copy()))

    def find_repeated(self) -> Finding | None:
        """Finds runs of identical images between whose poses the camera moves.

        Returns:
            ``repeated_image`` with the frames of all runs, or ``None``.
        """
        frames: list[int] = []
        farthest_m = 0.0
        for _, group in groupby(self._images, key=lambda image: image[1]):
            run = list(group)
            positions = np.stack([position for _, _, position in run])
            motion_m = float(np.linalg.norm(positions - positions[0], axis=1).max())
            if motion_m > _MIN_MOTION_M:
                frames += [frame for frame, _, _ in run]
                farthest_m = max(farthest_m, motion_m)
        if not frames:
            return None
        message = f"{self._camera}: the images of frames {format_frames(frames)} repeat one another"
        message += f", while the camera moves by {farthest_m:.1f} m"
        numbers = {"motion_m": farthest_m, "limit_m": _MIN_MOTION_M}
        remedy = "The camera hung, or files were copied: leave only the first image of each run."
        return Finding("repeated_image", "warning", message, remedy, numbers, self._camera, tuple(frames))
