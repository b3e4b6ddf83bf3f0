"""The same bytes at any thread count: convolutions on one thread each, images side by side.

PyTorch's CPU convolutions and matrix products split their sums by the number of threads, so that their last bits depend
on it. Here each item is computed on exactly one thread, and the threads are used for several items at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


@contextmanager
def torch_threads(count: int | None) -> Iterator[None]:
    """Runs a block with ``count`` threads of torch, and restores their number afterwards.

    Args:
        count: number of threads; ``None`` keeps the present number.

    >>> before = torch.get_num_threads()
    >>> with torch_threads(1):
    ...     torch.get_num_threads()
    1
    >>> torch.get_num_threads() == before
    True
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def map_single_threaded(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """``[function(item) for item in items]`` in order, each call on one thread, ``torch.get_num_threads()`` at a time.

    The gradient mode is a property of a thread: ``function`` sets its own. Exceptions come through.
    """
    threads = torch.get_num_threads()
    try:
        if threads == 1 or len(items) < 2:
            torch.set_num_threads(1)
            return [function(item) for item in items]
        workers = min(threads, len(items))
        with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(function, items))
    finally:
        torch.set_num_threads(threads)
