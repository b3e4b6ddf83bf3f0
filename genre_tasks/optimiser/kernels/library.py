"""The optimiser's compiled kernel: how it is loaded, and the structures that it takes."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from genre_tasks.compiled.loader import load
from genre_tasks.errors import ResourceError
from genre_tasks.optimiser.kernels.build_network import KERNEL

# The structures hold pointers and 64-bit numbers only, in the order of network.cpp and features.h: so no compiler pads.
_Fields = list[tuple[str, type]]


def _pointers(names: str) -> _Fields:
    return [(name, ctypes.c_void_p) for name in names.split()]


def _numbers(names: str) -> _Fields:
    return [(name, ctypes.c_int64) for name in names.split()]


class Layer(ctypes.Structure):
    """A sparse layer of the UNet."""

    _fields_ = [
        *_pointers("input weight bias residual output starts pairs"),
        *_numbers("outputs channels_in channels_out activated"),
    ]


class Network(ctypes.Structure):
    """The weights of the dense layers."""

    _fields_ = [*_numbers("hidden varying"), *_pointers("entry entry_bias mix head head_bias")]


class Scene(ctypes.Structure):
    """What does not change over the iterations of one scene, and memory to work in."""

    _fields_ = [
        *_numbers("voxels"),
        *_pointers("base fixed voxel_of starts points active slot embedding pooled around"),
        ("layers", ctypes.POINTER(Layer)),
        *_numbers("layer_count"),
    ]


class StepInputs(ctypes.Structure):
    """The state in one iteration, and where the step is written."""

    _fields_ = [
        *_numbers("count"),
        *_pointers("offsets first_moment second_moment visit_count visible gradient by_count"),
        *_numbers("counts"),
        *_pointers("schedule_features signed_rates delta image_residuals lr_scale"),
    ]


class ShState(ctypes.Structure):
    """The state of spherical harmonics."""

    _fields_ = _pointers("coefficients first_moment second_moment visit_count basis_sums view_counts")


class ShStepInputs(ctypes.Structure):
    """One iteration of spherical harmonics, and where the state after it is written."""

    _fields_ = [
        *_numbers("count sh_count"),
        ("before", ShState),
        *_pointers("by_coefficients basis_sums view_counts by_colors by_count"),
        ("after", ShState),
        *_pointers("shift"),
    ]


@cache
def load_network(folder: Path = KERNEL.folder) -> ctypes.CDLL:
    """Loads the kernel once, with its argument types declared.

    Args:
        folder: where its libraries are.

    Returns:
        The library of the best instruction set of this machine.

    Raises:
        ResourceError: as :func:`genre_tasks.compiled.loader.load`.
        ConfigError: as there.
    """
    library = load(KERNEL, folder)
    inputs = ctypes.POINTER(StepInputs)
    pointer = ctypes.c_void_p
    library.genre_network_step.argtypes = [ctypes.POINTER(Network), ctypes.POINTER(Scene), inputs, ctypes.c_int]
    library.genre_adam_step.argtypes = [inputs, ctypes.c_int]
    # The types must be declared: without them ctypes passes a pointer as an int of 32 bits.
    learning_rates = [ctypes.c_float] * 2
    library.genre_accumulate.argtypes = [ctypes.c_int64, *[pointer] * 4, *learning_rates, ctypes.c_int, *[pointer] * 4]
    sh_inputs = ctypes.POINTER(ShStepInputs)
    library.genre_sh_step.argtypes = [sh_inputs, *[ctypes.c_float] * 3, ctypes.c_int]
    library.genre_apply_step.argtypes = [ctypes.c_int64, *[pointer] * 7, ctypes.c_int, pointer]
    return library


def is_supported(*tensors: Tensor) -> bool:
    """Tells whether the kernel takes these tensors.

    Args:
        tensors: everything that it would read.

    Returns:
        Whether all are float32 on the CPU.

    >>> is_supported(torch.zeros(2), torch.zeros(2, dtype=torch.float64))
    False
    """
    return all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)


def check_status(status: int) -> None:
    """Turns what a function of the kernel returns into an error.

    Args:
        status: 0 for success.

    Raises:
        ResourceError: for any other status; 1 is a lack of memory.
    """
    if status == 1:
        raise ResourceError("not enough memory for the optimiser's step", remedy="Take a scene with fewer Gaussians")
    if status:
        raise ResourceError(f"{KERNEL.title} failed", remedy="Report the number of Gaussians")
