"""What a step rule is, and the schedule that all rules share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from genre_tasks.errors import ConfigError
from genre_tasks.optimiser.state import GROUPS, Frame, State

SCHEDULE_END = 0.05


class Step(Protocol):
    """One scene's rule: ``step(state, gradient, total)`` → delta [N, 14]; ``gradient`` is already in the state.

    The delta is 0 where ``state.seen_now`` is.
    """

    def __call__(self, state: State, gradient: Tensor, total: int) -> Tensor: ...


class StepRule(Protocol):
    """How offsets move: the learned optimiser or tuned Adam.

    ``residuals``: whether the states that it is given have them.
    """

    @property
    def residuals(self) -> bool: ...

    def start(self, frame: Frame, centre: Tensor) -> Step:
        """Prepares for one scene; ``centre`` [3] is the mean position of the source cameras."""
        ...


def schedule(iteration: int, total: int) -> float:
    """Cosine from 1 down to ``SCHEDULE_END`` over ``total`` iterations, and ``SCHEDULE_END`` after them."""
    part = min(iteration / total, 1.0)
    return SCHEDULE_END + (1 - SCHEDULE_END) * 0.5 * (1 + math.cos(math.pi * part))


def rate_vector(rates: Sequence[float]) -> Tensor:
    """[14] from one rate for each of means (in units), log-scales, quaternions, logit opacities, colours."""
    if len(rates) != len(GROUPS) or not all(math.isfinite(r) and r >= 0 for r in rates):
        raise ConfigError(
            f"expected {len(GROUPS)} finite rates for {', '.join(GROUPS)}, got {list(rates)}",
            remedy="Correct the configuration beside the weights.",
        )
    return torch.cat([torch.full((b - a,), float(r)) for (a, b), r in zip(GROUPS.values(), rates, strict=True)])
