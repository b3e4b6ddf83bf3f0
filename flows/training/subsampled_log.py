"""A log with fewer images: where only source frames are needed, ray-casting or decoding the others costs time."""

from __future__ import annotations

from typing import Any

from genre_tasks.logs.types import DrivingLog


class ThinnedLog:
    """A log of which only every n-th frame has images; all else is the log's own."""

    def __init__(self, log: DrivingLog, every: int) -> None:
        self._log, self._every = log, every

    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """As the log's, or ``None`` for the frames that are left out."""
        return self._log.image_bytes(camera, frame) if frame % self._every == 0 else None
