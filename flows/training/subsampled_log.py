"""A log with fewer images: where only source frames are needed, ray-casting or decoding the others costs time."""

from __future__ import annotations

from typing import Any

from genre_tasks.logs.types import DrivingLog


class SubsampledLog:
    """A log of which only every n-th frame has images; everything else is the log's own.

    Args:
        log: any driving log.
        every: n; frame 0 has its images.
    """

    def __init__(self, log: DrivingLog, every: int) -> None:
        self._log = log
        self._every = every

    def __getattr__(self, name: str) -> Any:
        # Only called for what this class does not define: readers differ in what more they offer.
        return getattr(self._log, name)

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """Reads the encoded image of a camera at a frame.

        Args:
            camera: the camera's name.
            frame: frame of the log.

        Returns:
            The log's bytes, or ``None`` for the frames that are left out.
        """
        return self._log.image_bytes(camera, frame) if frame % self._every == 0 else None
