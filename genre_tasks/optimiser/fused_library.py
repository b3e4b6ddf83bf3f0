"""The optimiser's compiled kernel: how it is loaded, what it is told, and tuned Adam's step by it."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from genre_tasks.compiled.loader import load
from genre_tasks.errors import ResourceError
from genre_tasks.optimiser.build_network import KERNEL
from genre_tasks.optimiser.state import FIRST_DECAY, SECOND_DECAY, State

# The structures hold pointers and 64-bit numbers only, in the order of network.cpp and network_features.h.
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

    _fields_ = [*_numbers("hidden"), *_pointers("entry entry_bias mix head head_bias")]


class Scene(ctypes.Structure):
    """What stays over the iterations, and memory to work in."""

    _fields_ = [
        *_numbers("voxels"),
        *_pointers("base fixed voxel_of starts points own pooled around"),
        ("layers", ctypes.POINTER(Layer)),
        *_numbers("layer_count"),
    ]


class Now(ctypes.Structure):
    """The state in one iteration, and where the step goes."""

    _fields_ = [
        *_numbers("count"),
        *_pointers("offsets first second seen seen_now gradient by_seen"),
        *_numbers("counts"),
        *_pointers("times rates delta"),
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
    return library


def takes(*tensors: Tensor) -> bool:
    """Whether the kernel is made for these tensors: all float32 on the CPU."""
    return all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors)


def learned_step(network: Network, scene: Scene, state: State, gradient: Tensor, rates: Tensor, time: Tensor) -> Tensor:
    """The learned optimiser's step [N, 14] with the signed ``rates`` [14]; ``time`` [4]: the last features."""
    library = load_network()
    return _step(
        lambda now, threads: library.genre_network_step(network, scene, now, threads), state, gradient, rates, time
    )


def adam_step(state: State, rates: Tensor) -> Tensor:
    """Tuned Adam's step [N, 14] with the signed ``rates`` [14]; float32 on the CPU."""
    return _step(load_network().genre_adam_step, state, state.first, rates, rates)


def _step(call: Callable[[Now, int], int], state: State, gradient: Tensor, rates: Tensor, time: Tensor) -> Tensor:
    of_attributes = [state.offsets, state.first, state.second, gradient]
    rows = len(state.offsets)
    if any(t.shape != (rows, 14) for t in of_attributes) or any(len(t) != rows for t in (state.seen, state.seen_now)):
        raise ValueError(f"expected a state and a gradient [{rows}, 14], got {[list(t.shape) for t in of_attributes]}")
    arrays = [*of_attributes[:3], state.seen, state.seen_now, gradient]
    if not takes(*arrays):
        raise ValueError("expected float32 tensors on the CPU")
    arrays = [t.detach().contiguous() for t in arrays]
    by_seen, delta = _by_seen(arrays[3]), torch.empty_like(arrays[0])
    pointers = [t.data_ptr() for t in (*arrays, by_seen)]
    now = Now(rows, *pointers, len(by_seen), time.data_ptr(), rates.data_ptr(), delta.data_ptr())
    status = call(now, torch.get_num_threads())
    if status == 1:
        raise ResourceError("not enough memory for the optimiser's step", remedy="Take a scene with fewer Gaussians")
    if status:
        raise ResourceError(f"{KERNEL.title} failed", remedy="Report the number of Gaussians")
    return delta


def _by_seen(seen: Tensor) -> Tensor:
    """What depends on how often a Gaussian was seen, for 0 … the most: [counts, 3], as state.py and features.py say."""
    most = int(seen.numpy().max(initial=0))  # torch would wake its threads, which then spin beside the kernel's
    counts = torch.arange(most + 1, dtype=torch.float32)
    n = counts.clamp_min(1)
    return torch.stack([1 - FIRST_DECAY**n, 1 - SECOND_DECAY**n, torch.log1p(counts) / 3], 1)
