"""The state's two updates by the compiled kernel; the torch code in state.py, which calls this, is its oracle."""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.optimiser.kernels import library as library


def fits(*tensors: Tensor) -> bool:
    """Whether the kernel is made for these: float32 on the CPU, and no gradient is wanted through them."""
    return library.takes(*tensors) and not any(t.requires_grad for t in tensors)


def saw(
    gradient: Tensor,  # [N, 14]
    first: Tensor,  # [N, 14]
    second: Tensor,  # [N, 14]
    seen: Tensor,  # [N, 1]
    decays: tuple[float, float],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Both moments, ``seen`` and ``seen_now`` after the gradient; see ``State.saw``."""
    arrays = _contiguous((14, 14, 14, 1), gradient, first, second, seen)
    out = tuple(torch.empty_like(t) for t in (first, second, seen, seen))
    pointers, results = [t.data_ptr() for t in arrays], [t.data_ptr() for t in out]
    rates, kernel = [1 - d for d in decays], library.load_network()
    library.check(kernel.genre_saw(len(seen), *pointers, *rates, torch.get_num_threads(), *results))
    return out[0], out[1], out[2], out[3]


def moved(
    offsets: Tensor,  # [N, 14]
    delta: Tensor,  # [N, 14]
    seen_now: Tensor,  # [N, 1]
    start: Tensor,  # [N, 14]
    low: Tensor,  # [N, 14]
    high: Tensor,  # [N, 14]
    planes: Tensor,  # [N, 11]
) -> Tensor:
    """Offsets after ``delta``, along the ground and inside the bounds, where anything was seen now; see ``State``."""
    arrays = _contiguous((14, 14, 1, 14, 14, 14, 11), offsets, delta, seen_now, start, low, high, planes)
    out = torch.empty_like(offsets)
    pointers = [t.data_ptr() for t in arrays]
    library.check(library.load_network().genre_moved(len(offsets), *pointers, torch.get_num_threads(), out.data_ptr()))
    return out


def _contiguous(widths: tuple[int, ...], *tensors: Tensor) -> list[Tensor]:
    rows = len(tensors[0])
    if [tuple(t.shape) for t in tensors] != [(rows, width) for width in widths]:
        raise ValueError(f"expected {rows} rows of {widths} columns, got {[list(t.shape) for t in tensors]}")
    return [t.contiguous() for t in tensors]
