"""Under which circumstances a cell is measured: threads, and the log and chunk."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from benchmarks.common.bench import Row

THREADS = 2


def place(row: Row) -> str:
    """The log's short name with chunk and order."""
    name = f"{row['log'].split('/')[-1].removeprefix('synthetic:')} chunk {row['chunk']}"
    return f"{name} order {row['order']}" if "order" in row else name


@contextmanager
def threads(count: int = THREADS) -> Iterator[None]:
    """Torch and the renderer on so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
