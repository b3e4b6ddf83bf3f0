"""The steps that fit how actors deform, in the iterations that optimise their Gaussians."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from genre_tasks.optimiser.auxiliary import AuxiliaryParameters
from genre_tasks.optimiser.gradients import Gradients
from genre_tasks.optimiser.state import SECOND_MOMENT_DECAY
from genre_tasks.optimiser.step_rules import cosine_decay
from genre_tasks.scene.deformation import Deformation
from genre_tasks.scene.graph import SceneGraph

LEARNING_RATE_M = 0.1
"""Metres that a control point moves in a first step, if its gradient is as large as its actor's usually are."""

SMOOTHING = 0.4
"""How far a first step takes an offset towards the mean of its neighbours in time; 1 would replace it by the mean."""


class DeformationGroup:
    """Moves control points by gradients over their root mean square so far, as RMSprop does, without momentum.

    All control points of an actor at a frame have one root mean square, so that few Gaussians move theirs little. An
    actor is seen at a frame in five to ten iterations only; momentum from an earlier one would keep moving control
    points that their neighbours in time have corrected since.

    Args:
        deformation: where the optimisation starts.

    Attributes:
        deformation: present values.
    """

    def __init__(self, deformation: Deformation) -> None:
        self.deformation = deformation
        self._second_moment = torch.zeros_like(deformation.offsets[..., :1, :1])
        self._visit_count = torch.zeros_like(self._second_moment)
        # Frames at which an actor does not exist have no offsets, and take no part in the smoothing.
        self._known = torch.from_numpy(deformation.known).to(self._visit_count)[..., None, None]

    def contribute(self, auxiliary: AuxiliaryParameters) -> AuxiliaryParameters:
        """Adds the present deformation to what is rendered."""
        return replace(auxiliary, deformation=self.deformation)

    def apply(self, gradients: Gradients, iteration: int, total: int) -> None:
        """Takes one step against the gradient, then smooths along time.

        Args:
            gradients: of this iteration; without a gradient of the deformation nothing moves.
            iteration: from 0.
            total: T, the length of the schedule.
        """
        gradient = gradients.deformation
        if gradient is None:
            return
        # An actor that no view of this iteration shows at a frame has a gradient of exactly 0 there.
        visible = (gradient != 0).flatten(2).any(2)[..., None, None].to(gradient)
        self._visit_count += visible
        # One value per actor and frame. Divided by its own size, the gradient of a control point with hardly any
        # Gaussians around it would move that point as far as the others.
        mean_square = gradient.square().mean((2, 3), keepdim=True)
        self._second_moment += visible * (1 - SECOND_MOMENT_DECAY) * (mean_square - self._second_moment)
        bias_correction = 1 - SECOND_MOMENT_DECAY ** self._visit_count.clamp_min(1)
        rms = (self._second_moment / bias_correction).sqrt()
        # Before the first visit this would be 0 / 0.
        direction = visible * gradient / torch.where(rms > 0, rms, 1.0)
        lr_scale = cosine_decay(iteration, total)
        offsets = self.deformation.offsets - LEARNING_RATE_M * lr_scale * direction
        # Smoothing fades with the learning rate, so that late iterations follow the images and not the neighbours.
        neighbour_mean = self._mean_of_neighbours(offsets)
        offsets = offsets + lr_scale * SMOOTHING * self._known * (neighbour_mean - offsets)
        self.deformation = self.deformation.with_offsets(offsets)

    def write_back(self, scene: SceneGraph) -> SceneGraph:
        """Puts the present deformation into a scene."""
        return replace(scene, deformation=self.deformation)

    def _mean_of_neighbours(self, offsets: Tensor) -> Tensor:
        """Mean of the known offsets at the frames before and after; the offsets themselves where none is known."""
        total = torch.zeros_like(offsets)
        count = torch.zeros_like(self._known)
        later = slice(1, None)
        earlier = slice(None, -1)
        for frames, neighbours in ((later, earlier), (earlier, later)):
            total[:, frames] += (self._known * offsets)[:, neighbours]
            count[:, frames] += self._known[:, neighbours]
        return torch.where(count > 0, total / count.clamp_min(1), offsets)
