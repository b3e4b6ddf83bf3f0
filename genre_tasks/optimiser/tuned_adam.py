"""The baseline: Adam with per-attribute rates and one schedule, tuned for the horizon it is used at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from genre_tasks.optimiser.kernel_steps import adam_step
from genre_tasks.optimiser.kernels.library import takes
from genre_tasks.optimiser.state import Frame, State
from genre_tasks.optimiser.step_rules import Step, rate_vector, schedule

GNET_RATES = (0.2, 0.2, 0.05, 0.3, 0.02)
ENET_RATES = (0.1, 0.1, 0.025, 0.15, 0.01)


@dataclass(frozen=True)
class TunedAdam:
    """Δ = −rate · decay(t / T) · u, with moments that count only the iterations that saw a Gaussian.

    ``rates``: one for each of means (in units of the initial scale), log-scales, quaternions, logit opacities, colours.
    ``decay``: the learned optimiser's cosine, or none.
    """

    rates: Sequence[float] = GNET_RATES
    decay: Literal["cosine", "constant"] = "cosine"

    @property
    def residuals(self) -> bool:
        """Gradients are enough."""
        return False

    def start(self, frame: Frame, centre: Tensor) -> Step:
        """Nothing to prepare."""
        rates = rate_vector(self.rates)

        def step(state: State, gradient: Tensor, total: int) -> Tensor:
            part = schedule(state.iteration, total) if self.decay == "cosine" else 1.0
            if takes(state.first):
                return adam_step(state, -rates * part)
            return -rates.to(state.first.device) * part * state.direction() * state.seen_now

        return step
