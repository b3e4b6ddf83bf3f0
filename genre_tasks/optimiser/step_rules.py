"""What a step rule is, and the schedule of step lengths that all rules share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from genre_tasks.errors import ConfigError
from genre_tasks.optimiser.state import ATTRIBUTE_COLUMNS, Parameterization, State

# Above 0, because an optimisation may go on past T and must still be able to move.
FINAL_LR_SCALE = 0.05


class StepFunction(Protocol):
    """One scene's rule: from the state and the latest gradient to the next step."""

    def __call__(self, state: State, gradient: Tensor, total: int) -> Tensor:
        """Computes a step.

        Args:
            state: of N Gaussians, with ``gradient`` already accumulated.
            gradient: [N, 14] of this iteration.
            total: T, the length of the schedule; the state may be beyond it.

        Returns:
            [N, 14] step in the offsets, 0 for Gaussians that are not visible.
        """
        ...


class StepRule(Protocol):
    """A way to move offsets: the learned optimiser or tuned Adam."""

    @property
    def uses_image_residuals(self) -> bool:
        """Whether states must have image residuals."""
        ...

    def prepare(self, parameterization: Parameterization, camera_center: Tensor) -> StepFunction:
        """Sets the rule up for one scene.

        Args:
            parameterization: the scene at its start, and the units of the offsets.
            camera_center: [3] mean position of the source cameras, chunk coordinates.

        Returns:
            StepFunction: good for all iterations of this scene.
        """
        ...


def cosine_decay(iteration: int, total: int) -> float:
    """Scales learning rates from 1 down to ``FINAL_LR_SCALE`` along a cosine.

    Args:
        iteration: from 0.
        total: T; from there on the scale stays at its end.

    Returns:
        Factor of the learning rates, in [0.05, 1].

    >>> [round(cosine_decay(t, 24), 3) for t in (0, 12, 24, 100)]
    [1.0, 0.525, 0.05, 0.05]
    """
    progress = min(iteration / total, 1.0)
    return FINAL_LR_SCALE + (1 - FINAL_LR_SCALE) * 0.5 * (1 + math.cos(math.pi * progress))


def expand_learning_rates(learning_rates: Sequence[float]) -> Tensor:
    """Repeats the learning rate of each attribute for its columns.

    Args:
        learning_rates: of means (in units of the initial size), log-scales, quaternions, logit opacities and colours,
            as ``LearningRates.as_tuple``.

    Returns:
        [14] in the order of ``Gaussians.pack``.

    Raises:
        ConfigError: there are not five, or one is negative or not finite.

    >>> expand_learning_rates((1, 2, 3, 4, 5)).tolist()
    [1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 3.0, 4.0, 5.0, 5.0, 5.0]
    """
    # Checked here as well as in the configuration: weights bring rates of their own in their JSON.
    is_valid = all(math.isfinite(rate) and rate >= 0 for rate in learning_rates)
    if len(learning_rates) != len(ATTRIBUTE_COLUMNS) or not is_valid:
        raise ConfigError(
            f"expected {len(ATTRIBUTE_COLUMNS)} finite rates for {', '.join(ATTRIBUTE_COLUMNS)}, "
            f"got {list(learning_rates)}",
            remedy="Correct the configuration beside the weights.",
        )
    pairs = zip(ATTRIBUTE_COLUMNS.values(), learning_rates, strict=True)
    return torch.cat([torch.full((end - begin,), float(rate)) for (begin, end), rate in pairs])
