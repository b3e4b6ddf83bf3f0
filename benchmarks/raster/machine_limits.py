"""What this machine can do at most: multiply-adds of a matrix product, bytes of a copy."""

from __future__ import annotations

import torch

from benchmarks.common.timing import Action, on_threads

GEMM_SIZE = 2048
GEMM_FLOP = 2.0 * GEMM_SIZE**3
COPY_BYTES = 256 << 20
"""Many times the last-level cache; a copy reads and writes each of them."""


def gemm(threads: int) -> Action:
    """Makes an action that multiplies two float32 matrices.

    Args:
        threads: of torch.

    Returns:
        Action: ``GEMM_FLOP`` operations.
    """
    # The product goes into memory that is there already: allocation is not what is measured.
    g = torch.Generator().manual_seed(0)
    a, b = (torch.randn(GEMM_SIZE, GEMM_SIZE, generator=g) for _ in range(2))
    out = torch.empty_like(a)
    return on_threads(threads, lambda: torch.mm(a, b, out=out))


def copy(threads: int) -> Action:
    """Makes an action that copies ``COPY_BYTES`` from memory to memory.

    Args:
        threads: of torch.

    Returns:
        Action: one copy.
    """
    source = torch.zeros(COPY_BYTES // 4)
    target = torch.zeros_like(source)
    return on_threads(threads, lambda: target.copy_(source))
