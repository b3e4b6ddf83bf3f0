"""Steps by the compiled kernel: of the learned optimiser, of tuned Adam, and of spherical harmonics.

The first two share Adam's direction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

# As a module, so that a test can put another loader in its place.
from genre_tasks.optimiser.kernels import library as library
from genre_tasks.optimiser.kernels.constants import IMAGE_RESIDUALS
from genre_tasks.optimiser.state import FIRST_MOMENT_DECAY, SECOND_MOMENT_DECAY, State

KernelCall = Callable[[library.StepInputs, int], int]
"""A kernel function with all arguments set but the state and the number of threads; returns its status."""


def learned_step(
    network: library.Network,
    scene: library.Scene,
    state: State,
    gradient: Tensor,
    signed_rates: Tensor,
    schedule_features: Tensor,
    lr_scale: float,
) -> Tensor:
    """Runs the learned optimiser's network for one iteration.

    Args:
        network: weights of the dense layers.
        scene: voxels of the scene, and memory to work in.
        state: of N Gaussians, with ``gradient`` accumulated; with image residuals if the network takes them.
        gradient: [N, 14] of this iteration.
        signed_rates: [14] negative learning rates, with ``lr_scale`` in them.
        schedule_features: [4] the features that all Gaussians share.
        lr_scale: of the schedule, for the step towards the mean residual.

    Returns:
        [N, 14] step in the offsets, 0 for Gaussians that are not visible.

    Raises:
        ValueError: tensors do not fit together, or are not float32 on the CPU.
        ResourceError: the kernel is not compiled, or memory does not suffice.
    """
    kernel = library.load_network()

    def call(inputs: library.StepInputs, threads: int) -> int:
        return int(kernel.genre_network_step(network, scene, inputs, threads))

    return _step(call, state, gradient, signed_rates, schedule_features, state.image_residuals, lr_scale)


def adam_step(state: State, signed_rates: Tensor) -> Tensor:
    """Computes tuned Adam's step.

    Args:
        state: of N Gaussians, float32 on the CPU.
        signed_rates: [14] negative learning rates, with the scale of the schedule in them.

    Returns:
        [N, 14] step in the offsets, 0 for Gaussians that are not visible.

    Raises:
        ValueError: tensors do not fit together, or are not float32 on the CPU.
        ResourceError: the kernel is not compiled.
    """
    # The kernel reads neither the gradient nor the schedule's features here: any tensor of the right size will do.
    return _step(library.load_network().genre_adam_step, state, state.first_moment, signed_rates, signed_rates)


def sh_step(
    before: Sequence[Tensor], gradients: Sequence[Tensor], by_colors: Tensor, signed_rate: float
) -> tuple[list[Tensor], Tensor]:
    """Takes one step in spherical harmonics; the torch code of ``ShState`` is its oracle.

    Args:
        before: the tensors of ``ShState``, in its order, of N Gaussians.
        gradients: the tensors of ``ShGradients``, in its order.
        by_colors: [N, 3] gradient of the colours that all views share.
        signed_rate: negative learning rate, with the scale of the schedule in it.

    Returns:
        tuple: the tensors of the state afterwards, and the shift [N, 3] of the colours.

    Raises:
        ValueError: shapes do not fit together, or a tensor is not float32 on the CPU.
        ResourceError: the kernel is not compiled.
    """
    coefficients = before[0]
    count, sh_count, _ = coefficients.shape
    whole, column, colors = (count, sh_count, 3), (count, 1, 1), (count, 3)
    shapes = [whole, whole, column, column, whole, colors, whole, whole, colors, colors]
    arrays = [array.detach().contiguous() for array in (*before, *gradients, by_colors)]
    # The kernel knows no shapes: what passes here is read without another check.
    if [tuple(array.shape) for array in arrays] != shapes or not library.is_supported(*arrays):
        raise ValueError(f"expected float32 on the CPU of shapes {shapes}, got {[list(a.shape) for a in arrays]}")
    # New tensors: states are values.
    after = [torch.empty_like(array) for array in arrays[:6]]
    shift = torch.empty_like(arrays[9])
    # This iteration counts, too.
    by_count = _factors_by_count(_largest(arrays[3]) + 1)
    inputs = library.ShStepInputs(
        count,
        sh_count,
        library.ShState(*(array.data_ptr() for array in arrays[:6])),
        *(array.data_ptr() for array in arrays[6:]),
        by_count.data_ptr(),
        library.ShState(*(array.data_ptr() for array in after)),
        shift.data_ptr(),
    )
    decay_rates = (1 - FIRST_MOMENT_DECAY, 1 - SECOND_MOMENT_DECAY)
    threads = torch.get_num_threads()
    library.check_status(library.load_network().genre_sh_step(inputs, signed_rate, *decay_rates, threads))
    return after, shift


def _step(
    call: KernelCall,
    state: State,
    gradient: Tensor,
    signed_rates: Tensor,
    schedule_features: Tensor,
    image_residuals: Tensor | None = None,
    lr_scale: float = 0.0,
) -> Tensor:
    _check_shapes(state, gradient, image_residuals)
    arrays = [state.offsets, state.first_moment, state.second_moment, state.visit_count, state.visible, gradient]
    if image_residuals is not None:
        arrays.append(image_residuals)
    if not library.is_supported(*arrays):
        raise ValueError("expected float32 tensors on the CPU")
    arrays = [array.detach().contiguous() for array in arrays]
    by_count = _factors_by_count(_largest(arrays[3]))
    delta = torch.empty_like(arrays[0])
    # In a variable: the kernel reads it by its address, and a temporary would be freed before the call.
    scale = torch.tensor([lr_scale])
    inputs = library.StepInputs(
        len(delta),
        *(array.data_ptr() for array in arrays[:6]),
        by_count.data_ptr(),
        len(by_count),
        schedule_features.data_ptr(),
        signed_rates.data_ptr(),
        delta.data_ptr(),
        None if image_residuals is None else arrays[6].data_ptr(),
        scale.data_ptr(),
    )
    library.check_status(call(inputs, torch.get_num_threads()))
    return delta


def _check_shapes(state: State, gradient: Tensor, image_residuals: Tensor | None) -> None:
    rows = len(state.offsets)
    by_attribute = [state.offsets, state.first_moment, state.second_moment, gradient]
    columns = (state.visit_count, state.visible)
    if any(tensor.shape != (rows, 14) for tensor in by_attribute) or any(len(column) != rows for column in columns):
        shapes = [list(tensor.shape) for tensor in by_attribute]
        raise ValueError(f"expected a state and a gradient [{rows}, 14], got {shapes}")
    if image_residuals is not None and image_residuals.shape != (rows, IMAGE_RESIDUALS):
        raise ValueError(f"expected residuals [{rows}, {IMAGE_RESIDUALS}], got {list(image_residuals.shape)}")


def _largest(visit_count: Tensor) -> int:
    # Numpy, because torch would wake its threads, which then spin beside the kernel's threads.
    return int(visit_count.numpy().max(initial=0))


def _factors_by_count(largest: int) -> Tensor:
    """What depends only on how often a Gaussian was seen, for 0 … ``largest``.

    [counts, 3]: Adam's two bias corrections, and a feature of the network.
    """
    counts = torch.arange(largest + 1, dtype=torch.float32)
    # A table, because a power of the decays for each attribute would cost more than the rest of Adam's step.
    n = counts.clamp_min(1)
    return torch.stack([1 - FIRST_MOMENT_DECAY**n, 1 - SECOND_MOMENT_DECAY**n, torch.log1p(counts) / 3], 1)
