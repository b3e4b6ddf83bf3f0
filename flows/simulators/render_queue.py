"""One render at a time, however many clients ask: a render uses all cores already."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from genre_tasks.errors import ResourceError

# One for the process: renderers of several runs share its cores and its memory.
_RENDER_LOCK = threading.Lock()

# Known to the protocol alone, which is several calls away from the queue.
_IS_WANTED: ContextVar[Callable[[], bool] | None] = ContextVar("is_wanted", default=None)


@contextmanager
def render_while(is_wanted: Callable[[], bool]) -> Iterator[None]:
    """Says how renders within the block learn that their client has gone, so that nobody waits for an image of no one.

    Args:
        is_wanted: asked in the thread that renders, when its turn has come.

    >>> with render_while(lambda: False), RenderQueue(max_waiting=0).turn():
    ...     print("rendered")
    Traceback (most recent call last):
    genre_tasks.errors.ResourceError: the client has gone. Ask again.
    """
    token = _IS_WANTED.set(is_wanted)
    try:
        yield
    finally:
        _IS_WANTED.reset(token)


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
            ResourceError: too many wait already, or the client went away meanwhile, see :func:`render_while`.
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
                is_wanted = _IS_WANTED.get()
                if is_wanted is not None and not is_wanted():
                    raise ResourceError("the client has gone", remedy="Ask again.")
                yield
        finally:
            with self._count_lock:
                self._count -= 1
