"""The learned optimiser that GNet and ENet are (paper Sec. III-C, III-D), as a rule of steps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from genre_tasks.learned.features import Fixed, features
from genre_tasks.learned.kernel_step import FusedStep
from genre_tasks.learned.network import LearnedNetwork
from genre_tasks.learned.sparse_unet import VoxelPyramid
from genre_tasks.optimiser.kernels.library import takes
from genre_tasks.optimiser.state import Frame, State
from genre_tasks.optimiser.step_rules import Step
from genre_tasks.threads import map_single_threaded


class LearnedOptimiser(LearnedNetwork):
    """The network with its steps without gradients, compiled where it can be; used for GNet and ENet alike."""

    def at_rates(self, rates: Sequence[float]) -> LearnedOptimiser:
        """The same weights at other rates."""
        other = LearnedOptimiser(self.config.model_copy(update={"rates": tuple(rates)}))
        other.load_state_dict(self.state_dict())
        return other.eval().requires_grad_(False)

    def start(self, frame: Frame, centre: Tensor) -> Step:
        """See :class:`genre_tasks.optimiser.step_rules.StepRule`. The same bytes at any number of threads.

        float32 on the CPU is the compiled kernel's, with the weights as they are now; all else torch's, on one thread.
        """
        return self.step_of(frame, Fixed.of(frame, centre), self.pyramid(frame, centre))

    def step_of(self, frame: Frame, fixed: Fixed, pyramid: VoxelPyramid) -> Step:
        """As :meth:`start`, with what does not change over the iterations given."""
        if takes(frame.unit, fixed.columns, *self.parameters()):
            return FusedStep(self, frame, fixed, pyramid)

        def step(state: State, gradient: Tensor, total: int) -> Tensor:
            def one(_: int) -> Tensor:
                with torch.no_grad():
                    return self.delta(state, features(frame, fixed, state, gradient, total), pyramid, total)

            return map_single_threaded(one, (0,))[0]

        return step
