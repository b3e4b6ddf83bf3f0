"""One render at a time, however many clients ask: a render uses all cores already."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from genre_tasks.errors import ResourceError

# One for the process: renderers of several runs share its cores and its memory.
_RENDER_LOCK = threading.Lock()


class RenderQueue:
    """Lets one caller of the process after the other render, and refuses those that would wait too long.

    Args:
        max_waiting: calls that may wait while another one is rendered.

    >>> queue = RenderQueue(max_waiting=0)
    >>> with queue.turn():
    ...     queue.length
    1
    """

    def __init__(self, max_waiting: int) -> None:
        self._max_waiting = max_waiting
        self._count_lock = threading.Lock()
        self._count = 0

    @property
    def length(self) -> int:
        """Calls that are rendered or wait."""
        return self._count

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Waits until nobody else renders.

        Raises:
            ResourceError: too many wait already.
        """
        with self._count_lock:
            if self._count > self._max_waiting:
                raise ResourceError(
                    f"the renderer is busy: {self._count - 1} requests wait, and {self._max_waiting} may",
                    remedy="Ask again later, or start the service with a larger --queue.",
                )
            self._count += 1
        try:
            with _RENDER_LOCK:
                yield
        finally:
            with self._count_lock:
                self._count -= 1
