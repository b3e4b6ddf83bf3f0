"""The baseline: Adam with a learning rate per attribute, tuned for the number of iterations it is used with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from genre_tasks.config import LearningRates
from genre_tasks.optimiser.kernel_steps import adam_step
from genre_tasks.optimiser.kernels.library import is_supported
from genre_tasks.optimiser.state import Parameterization, State
from genre_tasks.optimiser.step_rules import StepFunction, cosine_decay, expand_learning_rates

GNET_LEARNING_RATES = LearningRates(means=0.2, log_scales=0.2, quats=0.05, logit_opacities=0.3, colors=0.02)
# Half of GNet's: ENet starts from a scene that is reconstructed already.
ENET_LEARNING_RATES = LearningRates(means=0.1, log_scales=0.1, quats=0.025, logit_opacities=0.15, colors=0.01)


@dataclass(frozen=True)
class TunedAdam:
    """Steps by Δ = −learning rate · lr scale(t / T) · u, with u the direction of Adam (Kingma and Ba 2015).

    Unlike in Adam, moments count only the iterations that saw a Gaussian.

    Attributes:
        learning_rates: per attribute; a mean's is in units of the Gaussian's initial size.
        schedule: ``cosine`` as the learned optimiser's, or ``constant``.

    >>> import torch
    >>> state = State.zeros(1, torch.empty(0)).accumulate(torch.full((1, 14), 3.0))
    >>> step = TunedAdam().prepare(None, torch.zeros(3))(state, torch.full((1, 14), 3.0), 24)
    >>> [round(x, 4) for x in step[0, 9:12].tolist()]
    [-0.05, -0.3, -0.02]
    """

    learning_rates: LearningRates = GNET_LEARNING_RATES
    schedule: Literal["cosine", "constant"] = "cosine"

    @property
    def uses_image_residuals(self) -> bool:
        """Gradients are enough: always false."""
        return False

    def prepare(self, parameterization: Parameterization, camera_center: Tensor) -> StepFunction:
        """Sets the rule up; it is the same for every scene.

        Args:
            parameterization: not used.
            camera_center: not used.

        Returns:
            StepFunction: by the kernel for float32 on the CPU, else by torch.
        """
        learning_rates = expand_learning_rates(self.learning_rates.as_tuple())

        def step(state: State, gradient: Tensor, total: int) -> Tensor:
            lr_scale = cosine_decay(state.iteration, total) if self.schedule == "cosine" else 1.0
            if is_supported(state.first_moment):
                # Negative, because the kernel's step is added.
                return adam_step(state, -learning_rates * lr_scale)
            # Any device and precision; the kernel above is for float32 on the CPU.
            rates: Tensor = learning_rates.to(state.first_moment.device)
            return -rates * lr_scale * state.adam_direction() * state.visible

        return step
