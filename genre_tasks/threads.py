"""The same bytes at any number of threads: each item on one thread, several items at once.

PyTorch's CPU convolutions and matrix products split their sums by the number of threads, so that their last bits depend
on it. Here each item is computed on exactly one thread, and the threads are used for several items at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

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
    """Applies a function to items, each call on one thread and ``torch.get_num_threads()`` calls at a time.

    Args:
        function: may run in a thread of its own. The gradient mode belongs to a thread, so it sets the mode that it
            needs.
        items: its arguments.

    Returns:
        ``[function(item) for item in items]``, in order.

    Raises:
        Exception: whatever ``function`` raises.

    >>> map_single_threaded(lambda x: x * x, [1, 2, 3])
    [1, 4, 9]
    """
    threads = torch.get_num_threads()
    try:
        if threads == 1 or len(items) < 2:
            # A pool of one worker would cost its start and give the same bits.
            torch.set_num_threads(1)
            return [function(item) for item in items]
        # As many workers as threads before, each with a single one: the CPU is as busy as it would be.
        workers = min(threads, len(items))
        with ThreadPoolExecutor(workers, initializer=_take_one_thread) as pool:
            # In the order of the items; an exception is that of the first item that failed.
            return list(pool.map(function, items))
    finally:
        torch.set_num_threads(threads)


def _take_one_thread() -> None:
    # A thread takes the process's number at its first question. Asked later, it would replace the 1, should another
    # thread have restored the number by then.
    torch.get_num_threads()
    torch.set_num_threads(1)


def multiply_transposed(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes aᵀ b, with the same bytes wherever torch has one thread, as within ``torch_threads(1)``.

    NumPy's product has other last bits at each number of threads of its BLAS, which torch does not set. These threads
    also wait for each other where other work is done at the same time.

    Args:
        a: [P, M].
        b: [P, N].

    Returns:
        [M, N].

    >>> multiply_transposed(np.array([[1.0], [2.0]]), np.array([[3.0], [4.0]])).tolist()
    [[11.0]]
    """
    product: NDArray[np.float64] = (torch.from_numpy(a).T @ torch.from_numpy(b)).numpy()
    return product
