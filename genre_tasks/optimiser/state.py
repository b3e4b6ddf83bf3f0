"""What an unrolled optimisation moves, in which units and bounds, and what it carries from iteration to iteration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from genre_tasks.optimiser.gradients import TOTAL_WEIGHT, WEIGHTED_RESIDUAL_RGB
from genre_tasks.optimiser.ground_constraint import compute_ground_constraint, project_onto_ground
from genre_tasks.optimiser.kernels import state_update
from genre_tasks.optimiser.kernels.constants import RMS_FLOOR, WEIGHT_FLOOR_PX
from genre_tasks.optimiser.kernels.posing import Posing
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, SceneGraph

ATTRIBUTE_COLUMNS = {
    "means": (0, 3),
    "log_scales": (3, 6),
    "quats": (6, 10),
    "logit_opacities": (10, 11),
    "colors": (11, 14),
}
"""First column and the one behind the last of each attribute, in the order of ``Gaussians.pack``."""

FIRST_MOMENT_DECAY = 0.9
"""Adam's β₁."""

SECOND_MOMENT_DECAY = 0.99
"""Adam's β₂. Its usual 0.999 would remember more iterations than an unrolled optimisation has."""

MIN_UNIT_M = 0.005
MAX_UNIT_M = 50.0
"""Bounds of the unit in which a mean moves, in metres."""

LOG_SCALE_BOUNDS = (-8.0, 1.0986)
"""ln metres, 0.3 mm to 3 m. A scale that starts outside may stay there."""

DISTANT_LOG_SCALE_BOUNDS = (-8.0, 4.6)
"""The same for the distant region, up to 100 m."""

MAX_GROWTH = 8.0
"""No side of a Gaussian grows beyond this multiple of its longest side at the start.

A spike along a car's outline can be thin in every source view and twenty times as long as it began. It then is a fog
over the whole image of a camera beside the path.
"""

LOGIT_BOUND = 9.0
"""Logit opacities stay within ± this."""

COLOR_BOUNDS = (-0.5, 1.5)
"""sRGB; beyond [0, 1] so that a clipped colour still has a gradient."""


@dataclass(frozen=True)
class Parameterization:
    """How offsets [N, 14] are applied to the scene at the start of an optimisation.

    A mean moves in units of its Gaussian's size, so that the distant shell and a lane marking share one learning rate.
    Everything else moves in raw space: log-scales, quaternions, logit opacities, colours.

    Attributes:
        scene: at the start.
        unit_m: [N, 1] metres: the median of the three initial scales (the radius of a disc), bounded.
        lower: [N, 14] bounds of the packed attributes.
        upper: [N, 14] as ``lower``.
        ground_constraint: [N, 11] of ``compute_ground_constraint``; all 0 where the ground is not constrained.
    """

    scene: SceneGraph
    unit_m: Tensor
    lower: Tensor
    upper: Tensor
    ground_constraint: Tensor

    @staticmethod
    def from_scene(scene: SceneGraph, constrain_ground: bool = True) -> Parameterization:
        """Sets up units, bounds and constraints of an optimisation that starts from a scene.

        Args:
            scene: of N Gaussians.
            constrain_ground: Gaussians on the ground move and turn within its plane only.

        Returns:
            Parameterization: at offsets of 0 it gives the scene itself.
        """
        initial = scene.gaussians.pack()
        log_scales = scene.gaussians.log_scales
        # The median of three scales is a disc's radius; its thickness says nothing of how far its mean may move.
        unit_m = log_scales.median(1).values.exp().clamp(MIN_UNIT_M, MAX_UNIT_M)[:, None]
        lower = torch.full_like(initial, -torch.inf)
        upper = torch.full_like(initial, torch.inf)
        is_distant = (scene.nodes == DISTANT)[:, None]
        lower[:, 3:6] = torch.where(is_distant, DISTANT_LOG_SCALE_BOUNDS[0], LOG_SCALE_BOUNDS[0])
        upper[:, 3:6] = torch.where(is_distant, DISTANT_LOG_SCALE_BOUNDS[1], LOG_SCALE_BOUNDS[1])
        # Relative to the start as well: see ``MAX_GROWTH``.
        longest = log_scales.max(1, keepdim=True).values
        upper[:, 3:6] = torch.minimum(upper[:, 3:6], longest + math.log(MAX_GROWTH))
        lower[:, 10] = -LOGIT_BOUND
        upper[:, 10] = LOGIT_BOUND
        lower[:, 11:14] = COLOR_BOUNDS[0]
        upper[:, 11:14] = COLOR_BOUNDS[1]
        # Attributes that start out of bounds stay free to remain there: a clamp would move them without a gradient.
        lower = torch.minimum(lower, initial)
        upper = torch.maximum(upper, initial)
        constraint = compute_ground_constraint(scene) if constrain_ground else initial.new_zeros((len(initial), 11))
        return Parameterization(scene, unit_m, lower, upper, constraint)

    @cached_property
    def initial(self) -> Tensor:
        """The packed attributes [N, 14] at the start."""
        return self.scene.gaussians.pack()

    @cached_property
    def posing(self) -> Posing:
        """What the kernels keep over the iterations to pose the Gaussians; for float32 on the CPU only."""
        return Posing(self.scene, self.initial.detach(), self.unit_m.detach())

    def gaussians_at(self, offsets: Tensor) -> Gaussians:
        """Applies offsets.

        Args:
            offsets: [N, 14] means in units, everything else in raw space.

        Returns:
            Gaussians: differentiable in ``offsets``.
        """
        start = self.scene.gaussians
        shift = Gaussians.unpack(offsets)
        return Gaussians(
            start.means + shift.means * self.unit_m,
            start.log_scales + shift.log_scales,
            start.quats + shift.quats,
            start.logit_opacities + shift.logit_opacities,
            start.colors + shift.colors,
        )

    def clamp(self, offsets: Tensor) -> Tensor:
        """Keeps attributes inside their bounds.

        Args:
            offsets: [N, 14].

        Returns:
            [N, 14]; offsets whose attributes are inside stay the same bytes.
        """
        attributes = self.initial + offsets
        clamped = torch.minimum(torch.maximum(attributes, self.lower), self.upper)
        # Offsets inside are returned as they were: initial + offset - initial would round them in every step.
        is_outside = (attributes != clamped) & (self.lower > -torch.inf)
        return torch.where(is_outside, clamped - self.initial, offsets)


@dataclass(frozen=True)
class State:
    """The offsets after some iterations, and what the step rules know of the gradients so far.

    Moments and counts are over the iterations that saw a Gaussian, which are those with a gradient that is not zero.

    Attributes:
        offsets: [N, 14] from the start.
        first_moment: [N, 14] mean gradient, exponentially weighted.
        second_moment: [N, 14] mean squared gradient, exponentially weighted.
        visit_count: [N, 1] how many iterations saw the Gaussian.
        visible: [N, 1] 1 if the latest iteration saw it, else 0.
        iteration: number of steps taken.
        image_residuals: [N, 5] of the latest iteration, as in ``Gradients``; ``None`` unless the step rule asks.
    """

    offsets: Tensor
    first_moment: Tensor
    second_moment: Tensor
    visit_count: Tensor
    visible: Tensor
    iteration: int = 0
    image_residuals: Tensor | None = None

    @staticmethod
    def zeros(count: int, like: Tensor) -> State:
        """The state before the first iteration.

        Args:
            count: N.
            like: any tensor of the dtype and device to use.

        Returns:
            State: of zeros.

        >>> State.zeros(5, torch.empty(0)).offsets.shape
        torch.Size([5, 14])
        """
        zeros = like.new_zeros((count, 14))
        column = like.new_zeros((count, 1))
        return State(zeros, zeros, zeros, column, column)

    def accumulate(self, gradient: Tensor, image_residuals: Tensor | None = None) -> State:
        """Takes an iteration's gradient into the moments and counts.

        Args:
            gradient: [N, 14] with respect to the offsets.
            image_residuals: [N, 5] of the same iteration.

        Returns:
            State: at the same offsets.
        """
        if state_update.is_supported(gradient, self.first_moment, self.second_moment, self.visit_count):
            decays = (FIRST_MOMENT_DECAY, SECOND_MOMENT_DECAY)
            first, second, count, visible = state_update.accumulate(
                gradient, self.first_moment, self.second_moment, self.visit_count, decays
            )
        else:
            # NaN counts as visible too, so that a broken gradient is found and not hidden.
            visible = (gradient != 0).any(1, keepdim=True).to(gradient.dtype)
            # Moments of Gaussians that were not seen keep their values, where Adam would let them decay.
            first = self.first_moment + visible * (1 - FIRST_MOMENT_DECAY) * (gradient - self.first_moment)
            square = gradient * gradient
            second = self.second_moment + visible * (1 - SECOND_MOMENT_DECAY) * (square - self.second_moment)
            count = self.visit_count + visible
        return replace(
            self,
            first_moment=first,
            second_moment=second,
            visit_count=count,
            visible=visible,
            image_residuals=image_residuals,
        )

    def apply_step(self, parameterization: Parameterization, delta: Tensor) -> State:
        """Moves what the latest iteration saw, within the bounds and along the ground.

        Momentum from earlier views would keep moving Gaussians that no current view corrects. So Gaussians that this
        iteration did not see stay the same bytes.

        Args:
            parameterization: of this optimisation.
            delta: [N, 14] step in the offsets.

        Returns:
            State: one iteration further.
        """
        p = parameterization
        fixed = (p.initial, p.lower, p.upper, p.ground_constraint)
        # The kernel has no gradient; a delta that needs one goes torch's way.
        if state_update.is_supported(self.offsets, delta, self.visible, *fixed):
            offsets = state_update.apply_step(self.offsets, delta, self.visible, *fixed)
        else:
            delta = project_onto_ground(delta, p.ground_constraint)
            offsets = torch.where(self.visible > 0, p.clamp(self.offsets + delta), self.offsets)
        return replace(self, offsets=offsets, iteration=self.iteration + 1)

    def shift_colors(self, shift: Tensor) -> State:
        """Moves the colours by ``shift`` [N, 3], unbounded."""
        # A copy, because states are values.
        offsets = self.offsets.clone()
        offsets[:, 11:14] += shift
        return replace(self, offsets=offsets)

    def rms_gradient(self) -> Tensor:
        """Root of the unbiased second moment, [N, 14], > 0."""
        bias_correction = 1 - SECOND_MOMENT_DECAY ** self.visit_count.clamp_min(1)
        return (self.second_moment / bias_correction).sqrt() + RMS_FLOOR

    def adam_direction(self) -> Tensor:
        """Adam's normalised step [N, 14], of order 1; exactly 0 for Gaussians that no iteration has seen."""
        bias_correction = 1 - FIRST_MOMENT_DECAY ** self.visit_count.clamp_min(1)
        # After a rare strong gradient the ratio can be large; the bound keeps one step from throwing a Gaussian away.
        return (self.first_moment / bias_correction / self.rms_gradient()).clamp(-6.0, 6.0)

    def mean_residual_rgb(self) -> Tensor:
        """Mean residual [N, 3] over the pixels that show a Gaussian, by its blending weight there.

        It goes to 0 for a Gaussian whose weights add up to less than a pixel.
        """
        assert self.image_residuals is not None
        total_weight = self.image_residuals[:, TOTAL_WEIGHT]
        return self.image_residuals[:, WEIGHTED_RESIDUAL_RGB] / (total_weight + WEIGHT_FLOOR_PX)
