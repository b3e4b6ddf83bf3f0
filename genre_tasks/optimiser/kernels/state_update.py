"""The two updates of an optimiser's state by the compiled kernel; the torch code of ``State`` is its oracle."""

from __future__ import annotations

import torch
from torch import Tensor

# As a module, so that a test can put another loader in its place.
from genre_tasks.optimiser.kernels import library as library


def is_supported(*tensors: Tensor) -> bool:
    """Tells whether the kernel takes these tensors.

    Args:
        tensors: everything that it would read.

    Returns:
        Whether all are float32 on the CPU, and none needs a gradient through the update.

    >>> is_supported(torch.zeros(2)), is_supported(torch.zeros(2, requires_grad=True))
    (True, False)
    """
    return library.is_supported(*tensors) and not any(tensor.requires_grad for tensor in tensors)


def accumulate(
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    visit_count: Tensor,
    decays: tuple[float, float],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Takes a gradient into the moments, as ``State.accumulate``.

    Args:
        gradient: [N, 14] of this iteration.
        first_moment: [N, 14].
        second_moment: [N, 14].
        visit_count: [N, 1].
        decays: of the first and of the second moment.

    Returns:
        tuple: both moments and the count afterwards, and ``visible`` [N, 1].

    Raises:
        ValueError: a shape does not fit.
        ResourceError: the kernel is not compiled.
    """
    arrays = _contiguous((14, 14, 14, 1), gradient, first_moment, second_moment, visit_count)
    # New tensors: states are values, and a checkpoint may still hold the one before.
    new_first = torch.empty_like(first_moment)
    new_second = torch.empty_like(second_moment)
    new_count = torch.empty_like(visit_count)
    visible = torch.empty_like(visit_count)
    first_decay, second_decay = decays
    status = library.load_network().genre_accumulate(
        len(visit_count),
        *(array.data_ptr() for array in arrays),
        1 - first_decay,
        1 - second_decay,
        torch.get_num_threads(),
        *(out.data_ptr() for out in (new_first, new_second, new_count, visible)),
    )
    library.check_status(status)
    return new_first, new_second, new_count, visible


def apply_step(
    offsets: Tensor,
    delta: Tensor,
    visible: Tensor,
    initial: Tensor,
    lower: Tensor,
    upper: Tensor,
    ground_constraint: Tensor,
) -> Tensor:
    """Moves offsets along the ground and within their bounds, as ``State.apply_step``.

    Args:
        offsets: [N, 14] from the start.
        delta: [N, 14] step.
        visible: [N, 1]; rows of 0 stay as they are.
        initial: [N, 14] attributes at the start.
        lower: [N, 14] bounds of the attributes.
        upper: [N, 14] bounds of the attributes.
        ground_constraint: [N, 11] of ``compute_ground_constraint``.

    Returns:
        [N, 14] offsets afterwards.

    Raises:
        ValueError: a shape does not fit.
        ResourceError: the kernel is not compiled.
    """
    widths = (14, 14, 1, 14, 14, 14, 11)
    arrays = _contiguous(widths, offsets, delta, visible, initial, lower, upper, ground_constraint)
    out = torch.empty_like(offsets)
    pointers = [array.data_ptr() for array in arrays]
    threads = torch.get_num_threads()
    library.check_status(library.load_network().genre_apply_step(len(offsets), *pointers, threads, out.data_ptr()))
    return out


def _contiguous(widths: tuple[int, ...], *tensors: Tensor) -> list[Tensor]:
    rows = len(tensors[0])
    if [tuple(tensor.shape) for tensor in tensors] != [(rows, width) for width in widths]:
        raise ValueError(f"expected {rows} rows of {widths} columns, got {[list(tensor.shape) for tensor in tensors]}")
    # No copy in the loop, whose tensors are contiguous already.
    return [tensor.contiguous() for tensor in tensors]
