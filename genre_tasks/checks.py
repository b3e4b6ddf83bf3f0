"""Checks that stop a computation at its first value that is not finite."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from genre_tasks.errors import NonFiniteError

if TYPE_CHECKING:
    pass


def check_finite(values: Tensor, name: str, stage: str, **where: object) -> None:
    """Raises ``NonFiniteError`` naming the tensor and its first non-finite entry."""
    if math.isfinite(_sum(values)):  # a tenth of the time; a sum that only overflows is looked at again below
        return
    bad = ~torch.isfinite(values)
    if bool(bad.any()):
        first = tuple(torch.nonzero(bad)[0].tolist())
        raise NonFiniteError(stage, name, int(bad.sum()), first, **where)


def _sum(values: Tensor) -> float:
    """On the CPU by numpy: torch would wake its threads, which then spin for milliseconds beside the kernels'."""
    if values.device.type == "cpu":
        with np.errstate(over="ignore", invalid="ignore"):
            return float(values.detach().numpy().sum())
    return float(values.sum())
