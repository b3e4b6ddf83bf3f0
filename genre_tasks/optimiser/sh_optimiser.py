"""How harmonics move beside the 14 attributes: Adam, in the same iterations.

Source views see a Gaussian from few directions, between which its harmonics Y_k differ little: most of a step in them
would be a step of the colour that all views see. So the step is that of colour + Σ h_k (Y_k(d) − Ȳ_k), with Ȳ_k their
mean over the views that have seen the Gaussian: harmonics explain what differs between views, the colour what they
share. Its length is measured by the colour's gradient: what is seen from nearly one direction gets small harmonics.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from genre_tasks.optimiser.kernels.constants import DEVIATION_FLOOR
from genre_tasks.optimiser.state import FIRST_DECAY, SECOND_DECAY
from genre_tasks.threads import map_single_threaded

RATE = 0.15
"""Of a step at the start, in sRGB times a harmonic. At degree 2 held-out views and those at 3 m hardly differ from 0.07
to 0.15 (0.03 and 0.01 dB; glossy streets 900 and 902, the real chunk 0); degree 1 is 0.07 to 0.13 dB behind on the
path, and at twice the rate and more loses more at 3 m."""


@dataclass(frozen=True)
class GlossSight:
    """What an iteration's views tell: the gradient by the harmonics, the harmonics' sum over the views that a Gaussian
    has a gradient in, and how many those are; by channel."""

    gradient: Tensor  # [N, K, 3]
    sums: Tensor  # [N, K, 3]
    views: Tensor  # [N, 3]


@dataclass(frozen=True)
class GlossState:
    """``harmonics`` [N, K, 3], moments of their gradient over the iterations that saw a Gaussian, the number of those.

    The decays are those of ``State``; the second moment is the colour's.
    """

    harmonics: Tensor
    first: Tensor  # [N, K, 3]
    second: Tensor  # [N, 1, 1]
    seen: Tensor  # [N, 1, 1]
    sums: Tensor  # [N, K, 3] as of a sight, over all iterations
    views: Tensor  # [N, 3]

    @staticmethod
    def start(harmonics: Tensor) -> GlossState:
        """Nothing seen."""
        zeros, column = torch.zeros_like(harmonics), harmonics.new_zeros((len(harmonics), 1, 1))
        return GlossState(harmonics, zeros, column, column, zeros, zeros[:, 0])

    def moved(self, sight: GlossSight, by_colors: Tensor, part: float) -> tuple[GlossState, Tensor]:
        """A step of ``part`` of the rate of what this iteration's views saw, and what the colours [N, 3] move with it.

        ``by_colors`` [N, 3] is their gradient. On one thread: the bits do not depend on their number.
        """
        return map_single_threaded(lambda x: self._moved(x, by_colors, part), [sight])[0]

    def _moved(self, sight: GlossSight, by_colors: Tensor, part: float) -> tuple[GlossState, Tensor]:
        sums, views = self.sums + sight.sums, self.views + sight.views
        mean = sums / views.clamp_min(1)[:, None]
        gradient = sight.gradient - mean * by_colors[:, None]
        square = by_colors.square().mean(1)[:, None, None]
        now = (square > 0).to(gradient.dtype)
        first = self.first + now * (1 - FIRST_DECAY) * (gradient - self.first)
        second = self.second + now * (1 - SECOND_DECAY) * (square - self.second)
        seen = self.seen + now
        deviation = (second / (1 - SECOND_DECAY ** seen.clamp_min(1))).sqrt() + DEVIATION_FLOOR
        scale = now / ((1 - FIRST_DECAY ** seen.clamp_min(1)) * deviation)
        step = -RATE * part * (first * scale).clamp(-6.0, 6.0)
        moved = GlossState(self.harmonics + step, first, second, seen, sums, views)
        return moved, -(mean * step).sum(1)
