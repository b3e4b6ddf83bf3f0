"""How harmonics move beside the 14 attributes: Adam, in the same iterations."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from genre_tasks.metrics.threads import map_single_threaded
from genre_tasks.optimiser.network_constants import DEVIATION_FLOOR
from genre_tasks.optimiser.state import FIRST_DECAY, SECOND_DECAY

RATE = 0.02
"""Of a step at the schedule's start, in sRGB times a harmonic; tuned on streets 900 and 901 for 24 iterations."""


@dataclass(frozen=True)
class GlossState:
    """``harmonics`` [N, K, 3], moments of their gradient over the iterations that saw a Gaussian, the number of those.

    The moments are those of ``State``, a Gaussian's harmonics share one second moment: the step keeps the gradient's
    direction among them, as harmonics that the views tell nothing of shall stay small.
    """

    harmonics: Tensor
    first: Tensor  # [N, K, 3]
    second: Tensor  # [N, 1, 1]
    seen: Tensor  # [N, 1, 1]

    @staticmethod
    def start(harmonics: Tensor) -> GlossState:
        """Nothing seen."""
        column = harmonics.new_zeros((len(harmonics), 1, 1))
        return GlossState(harmonics, torch.zeros_like(harmonics), column, column)

    def moved(self, gradient: Tensor, part: float) -> GlossState:
        """A step against the gradient [N, K, 3], ``part`` of the rate, of what this iteration's views saw.

        On one thread: the bits do not depend on their number.
        """
        return map_single_threaded(lambda x: self._moved(x, part), [gradient])[0]

    def _moved(self, gradient: Tensor, part: float) -> GlossState:
        square = gradient.square().flatten(1).mean(1)[:, None, None]
        now = (square > 0).to(gradient.dtype)
        first = self.first + now * (1 - FIRST_DECAY) * (gradient - self.first)
        second = self.second + now * (1 - SECOND_DECAY) * (square - self.second)
        seen = self.seen + now
        deviation = (second / (1 - SECOND_DECAY ** seen.clamp_min(1))).sqrt() + DEVIATION_FLOOR
        scale = now / ((1 - FIRST_DECAY ** seen.clamp_min(1)) * deviation)
        return GlossState(self.harmonics - RATE * part * (first * scale).clamp(-6.0, 6.0), first, second, seen)
