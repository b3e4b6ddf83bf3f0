"""Under which circumstances a cell is measured: the number of threads, and the log and chunk."""

from __future__ import annotations

from benchmarks.common.bench import Row

THREADS = 2
"""Threads of torch and the renderer where a benchmark does not say otherwise."""


def cell_label(row: Row) -> str:
    """Names what a row was measured on, shortly.

    Args:
        row: with ``log`` and ``chunk``, and ``order`` if it depends on the order of views.

    Returns:
        The log's last part with chunk and order.

    >>> cell_label({"log": "synthetic:street?seed=1001", "chunk": 0, "order": 2})
    'street?seed=1001 chunk 0 order 2'
    """
    name = f"{row['log'].split('/')[-1].removeprefix('synthetic:')} chunk {row['chunk']}"
    return f"{name} order {row['order']}" if "order" in row else name
