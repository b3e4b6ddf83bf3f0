"""Steps by the compiled kernel: the learned optimiser's and tuned Adam's, which share Adam's direction."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from genre_tasks.optimiser.kernels import library as library
from genre_tasks.optimiser.kernels.constants import RESIDUALS
from genre_tasks.optimiser.state import FIRST_DECAY, SECOND_DECAY, State


def learned_step(
    network: library.Network,
    scene: library.Scene,
    state: State,
    gradient: Tensor,
    rates: Tensor,
    time: Tensor,
    part: float,
) -> Tensor:
    """The learned optimiser's step [N, 14] with the signed ``rates`` [14]; ``time`` [4]: the last features.

    ``part``: the schedule's, which ``rates`` have in them. 0 where ``state.seen_now`` is.
    """
    kernel = library.load_network()

    def call(now: library.Now, threads: int) -> int:
        return int(kernel.genre_network_step(network, scene, now, threads))

    return _step(call, state, gradient, rates, time, state.residuals, part)


def adam_step(state: State, rates: Tensor) -> Tensor:
    """Tuned Adam's step [N, 14] with the signed ``rates`` [14], 0 where nothing was seen now; float32 on the CPU."""
    return _step(library.load_network().genre_adam_step, state, state.first, rates, rates)


def _step(
    call: Callable[[library.Now, int], int],
    state: State,
    gradient: Tensor,
    rates: Tensor,
    time: Tensor,
    residuals: Tensor | None = None,
    part: float = 0.0,
) -> Tensor:
    of_attributes = [state.offsets, state.first, state.second, gradient]
    rows = len(state.offsets)
    if any(t.shape != (rows, 14) for t in of_attributes) or any(len(t) != rows for t in (state.seen, state.seen_now)):
        raise ValueError(f"expected a state and a gradient [{rows}, 14], got {[list(t.shape) for t in of_attributes]}")
    if residuals is not None and residuals.shape != (rows, RESIDUALS):
        raise ValueError(f"expected residuals [{rows}, {RESIDUALS}], got {list(residuals.shape)}")
    arrays = [*of_attributes[:3], state.seen, state.seen_now, gradient, *([] if residuals is None else [residuals])]
    if not library.takes(*arrays):
        raise ValueError("expected float32 tensors on the CPU")
    arrays = [t.detach().contiguous() for t in arrays]
    by_seen, delta, scheduled = _by_seen(arrays[3]), torch.empty_like(arrays[0]), torch.tensor([part])
    pointers = [t.data_ptr() for t in (*arrays[:6], by_seen)]
    last = None if residuals is None else arrays[6].data_ptr(), scheduled.data_ptr()
    now = library.Now(rows, *pointers, len(by_seen), time.data_ptr(), rates.data_ptr(), delta.data_ptr(), *last)
    library.check(call(now, torch.get_num_threads()))
    return delta


def _by_seen(seen: Tensor) -> Tensor:
    """What depends on how often a Gaussian was seen, for 0 … the most: [counts, 3], as state.py and features.py say."""
    most = int(seen.numpy().max(initial=0))  # torch would wake its threads, which then spin beside the kernel's
    counts = torch.arange(most + 1, dtype=torch.float32)
    n = counts.clamp_min(1)
    return torch.stack([1 - FIRST_DECAY**n, 1 - SECOND_DECAY**n, torch.log1p(counts) / 3], 1)
