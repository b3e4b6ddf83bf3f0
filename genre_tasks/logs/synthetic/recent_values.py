"""Keeps values that are costly to make and likely to be asked for again."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class RecentValues(Generic[Value]):
    """Keeps the values that were used last, up to a number of bytes; safe among threads.

    Args:
        limit_bytes: how much to keep; the last value is kept whatever its size.
        count_bytes: how large a value is.
    """

    def __init__(self, limit_bytes: int, count_bytes: Callable[[Value], int]) -> None:
        self._limit_bytes = limit_bytes
        self._count_bytes = count_bytes
        self._total_bytes = 0
        self._values: OrderedDict[Hashable, Value] = OrderedDict()
        # Images may be asked for from several threads.
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """Gives the value of a key.

        Args:
            key: identifies the value.
            make: makes it if it is not there.

        Returns:
            The value.

        >>> squares = RecentValues(limit_bytes=100, count_bytes=lambda value: 10)
        >>> squares.get(3, lambda: 9), squares.get(3, lambda: 0)
        (9, 9)
        """
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        # Made outside the lock: two threads may make the same value, but none waits for another's.
        value = make()
        with self._lock:
            if key not in self._values:
                self._values[key] = value
                self._total_bytes += self._count_bytes(value)
            while self._total_bytes > self._limit_bytes and len(self._values) > 1:
                _, oldest = self._values.popitem(last=False)
                self._total_bytes -= self._count_bytes(oldest)
        return value
