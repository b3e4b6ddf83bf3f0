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

# The structures hold pointers and 64-bit numbers only, in the order of network.cpp and features.h.
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
    """What stays over the iterations, and memory to work in."""

    _fields_ = [
        *_numbers("voxels"),
        *_pointers("base fixed voxel_of starts points active slot own pooled around"),
        ("layers", ctypes.POINTER(Layer)),
        *_numbers("layer_count"),
    ]


class Now(ctypes.Structure):
    """The state in one iteration, and where the step goes."""

    _fields_ = [
        *_numbers("count"),
        *_pointers("offsets first second seen seen_now gradient by_seen"),
        *_numbers("counts"),
        *_pointers("times rates delta residuals part"),
    ]


@cache
def load_network(folder: Path = KERNEL.folder) -> ctypes.CDLL:
    """The kernel with its argument types declared, loaded once.

    Raises ``ResourceError`` and ``ConfigError`` as :func:`genre_tasks.compiled.loader.load`.
    """
    library = load(KERNEL, folder)
    now = ctypes.POINTER(Now)
    library.genre_network_step.argtypes = [ctypes.POINTER(Network), ctypes.POINTER(Scene), now, ctypes.c_int]
    library.genre_adam_step.argtypes = [now, ctypes.c_int]
    p, n, f = ctypes.c_void_p, ctypes.c_int64, ctypes.c_float
    library.genre_saw.argtypes = [n, p, p, p, p, f, f, ctypes.c_int, p, p, p, p]
    library.genre_moved.argtypes = [n, *[p] * 7, ctypes.c_int, p]
    return library


def takes(*tensors: Tensor) -> bool:
    """Whether the kernel is made for these tensors: all float32 on the CPU."""
    return all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors)


def check(status: int) -> None:
    """Raises ``ResourceError`` for what a function of the kernel returns other than 0."""
    if status == 1:
        raise ResourceError("not enough memory for the optimiser's step", remedy="Take a scene with fewer Gaussians")
    if status:
        raise ResourceError(f"{KERNEL.title} failed", remedy="Report the number of Gaussians")
