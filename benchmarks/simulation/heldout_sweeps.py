"""A log whose LiDAR sweeps are held out at some frames, so that simulated sweeps can be compared with real ones.

``heldout-sweeps:2/pandaset:PATH/002`` has the sweeps of every second frame; images and everything else are the log's.
"""

from __future__ import annotations

import hashlib
from typing import Any

from genre_tasks.errors import InputError
from genre_tasks.logs.registry import open_log, register
from genre_tasks.logs.types import DrivingLog, Sweep

READER = "heldout-sweeps"


class HeldoutSweepsLog:
    """A ``DrivingLog`` without the sweeps of the frames that are held out.

    Args:
        log: any driving log.
        every: frames that are multiples of it have their sweep; the others are held out.

    Raises:
        InputError: ``every`` is below 2, which would hold nothing out.
    """

    def __init__(self, log: DrivingLog, every: int) -> None:
        if every < 2:
            raise InputError(f"every {every}. sweep stays, so none is held out", remedy="Choose 2 or more.")
        self._log = log
        self._every = every

    def __getattr__(self, name: str) -> Any:
        # Only called for what this class does not define.
        return getattr(self._log, name)

    @property
    def uri(self) -> str:
        """See ``DrivingLog``."""
        return f"{READER}:{self._every}/{self._log.uri}"

    @property
    def name(self) -> str:
        """See ``DrivingLog``; not the log's, so that the two never share a folder of a store."""
        return f"{self._log.name}-sweeps={self._every}"

    def holds_out(self, frame: int) -> bool:
        """Tells whether the sweep of a frame is held out.

        Args:
            frame: of the log.
        """
        return frame % self._every != 0

    def sweep(self, frame: int) -> Sweep | None:
        """See ``DrivingLog``; ``None`` where the sweep is held out."""
        return None if self.holds_out(frame) else self._log.sweep(frame)

    def digest(self) -> str:
        """See ``DrivingLog``; differs from the log's, since a reconstruction reads fewer sweeps."""
        return hashlib.sha256(f"{READER}:{self._every}:{self._log.digest()}".encode()).hexdigest()


def open_heldout_sweeps(rest: str) -> HeldoutSweepsLog:
    """Opens ``EVERY/READER:WHERE``.

    Args:
        rest: what follows ``heldout-sweeps:`` in a URI.

    Returns:
        The log without the sweeps that are held out.

    Raises:
        InputError: the text does not begin with a number and a slash, or the log cannot be opened.
    """
    every, slash, uri = rest.partition("/")
    if not (slash and every.isdigit()):
        remedy = f"Write {READER}:2/pandaset:PATH/002, for instance."
        raise InputError(f"'{rest}' does not say which sweeps stay", remedy=remedy, log=uri)
    return HeldoutSweepsLog(open_log(uri), int(every))


def register_reader() -> None:
    """Lets ``open_log`` open logs with held-out sweeps; not on import, since users need no such reader."""
    register(READER, f"{__name__}:open_heldout_sweeps", "nothing", example=f"{READER}:2/pandaset:PATH/002")
