"""The steps that fit spherical harmonics, in the iterations that optimise the Gaussians: Adam.

Source views see a Gaussian from few directions d, between which its basis functions Y_k(d) differ little. Most of a
plain step in the coefficients h_k would therefore be a step of the colour that all views see. So the step is that of

    colour + Σ h_k (Y_k(d) − Ȳ_k)

with Ȳ_k the mean of Y_k over the views that have seen the Gaussian. Coefficients then explain what differs between
views, and the colour what they share. The step's length is measured by the gradient of the colour: a Gaussian that is
seen from nearly one direction gets small coefficients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from genre_tasks.optimiser.auxiliary import AuxiliaryParameters
from genre_tasks.optimiser.gradients import Gradients, ShGradients
from genre_tasks.optimiser.kernel_steps import sh_step
from genre_tasks.optimiser.kernels.constants import RMS_FLOOR
from genre_tasks.optimiser.kernels.library import is_supported
from genre_tasks.optimiser.state import FIRST_MOMENT_DECAY, SECOND_MOMENT_DECAY
from genre_tasks.optimiser.step_rules import cosine_decay
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.threads import torch_threads

LEARNING_RATE = 0.15
"""Of a first step, in sRGB per unit of a basis function.

At degree 2, held-out views and those at 3 m hardly differ from 0.07 to 0.15; twice the rate loses more at 3 m.
"""


@dataclass(frozen=True)
class ShState:
    """Coefficients, and what Adam knows of them after some iterations. The decays are those of ``State``.

    Attributes:
        coefficients: [N, K, 3].
        first_moment: [N, K, 3] mean gradient over the iterations that saw the Gaussian.
        second_moment: [N, 1, 1] mean square of the colour's gradient over them.
        visit_count: [N, 1, 1] how many iterations these are.
        basis_sums: [N, K, 3] basis functions, summed over all views that saw the Gaussian.
        view_counts: [N, 3] how many views these are.
    """

    coefficients: Tensor
    first_moment: Tensor
    second_moment: Tensor
    visit_count: Tensor
    basis_sums: Tensor
    view_counts: Tensor

    @staticmethod
    def from_coefficients(coefficients: Tensor) -> ShState:
        """Starts at coefficients [N, K, 3] that no iteration has seen.

        >>> ShState.from_coefficients(torch.ones(5, 8, 3)).visit_count.shape
        torch.Size([5, 1, 1])
        """
        zeros = torch.zeros_like(coefficients)
        column = coefficients.new_zeros((len(coefficients), 1, 1))
        return ShState(coefficients, zeros, column, column, zeros, zeros[:, 0])

    def apply_step(self, gradients: ShGradients, by_colors: Tensor, lr_scale: float) -> tuple[ShState, Tensor]:
        """Takes one step in the coefficients of what this iteration's views saw.

        Args:
            gradients: of the coefficients.
            by_colors: [N, 3] gradient of the colours that all views share.
            lr_scale: factor of the learning rate, in [0, 1].

        Returns:
            tuple: the next state, and the shift [N, 3] of the colours that keeps the mean over views where it was.
        """
        tensors = [getattr(self, field.name) for field in fields(self)]
        if is_supported(*tensors, by_colors):
            by_harmonics = (gradients.coefficients, gradients.basis_sums, gradients.view_counts)
            after, shift = sh_step(tensors, by_harmonics, by_colors, -LEARNING_RATE * lr_scale)
            return ShState(*after), shift
        # On one thread, so that the bits of the sums do not depend on the number of threads.
        with torch_threads(1):
            return self.apply_torch_step(gradients, by_colors, lr_scale)

    def apply_torch_step(self, gradients: ShGradients, by_colors: Tensor, lr_scale: float) -> tuple[ShState, Tensor]:
        """Takes the step of :meth:`apply_step` with torch, on any device and in any precision: the kernel's oracle.

        Args:
            gradients: of the coefficients.
            by_colors: [N, 3] gradient of the colours that all views share.
            lr_scale: factor of the learning rate, in [0, 1].

        Returns:
            tuple: as :meth:`apply_step`.
        """
        basis_sums = self.basis_sums + gradients.basis_sums
        view_counts = self.view_counts + gradients.view_counts
        # The mean is over all views so far: the few views of one iteration would all but have a mean of their own.
        basis_mean = basis_sums / view_counts.clamp_min(1)[:, None]
        gradient = gradients.coefficients - basis_mean * by_colors[:, None]
        # The colour's gradient is the measure, not the coefficients' own, as the module's docstring explains.
        mean_square = by_colors.square().mean(1)[:, None, None]
        visible = (mean_square > 0).to(gradient.dtype)
        first_moment = self.first_moment + visible * (1 - FIRST_MOMENT_DECAY) * (gradient - self.first_moment)
        second_moment = self.second_moment + visible * (1 - SECOND_MOMENT_DECAY) * (mean_square - self.second_moment)
        visit_count = self.visit_count + visible
        visits = visit_count.clamp_min(1)
        rms = (second_moment / (1 - SECOND_MOMENT_DECAY**visits)).sqrt() + RMS_FLOOR
        scale = visible / ((1 - FIRST_MOMENT_DECAY**visits) * rms)
        # Bounded as ``State.adam_direction``.
        step = -LEARNING_RATE * lr_scale * (first_moment * scale).clamp(-6.0, 6.0)
        coefficients = self.coefficients + step
        state = ShState(coefficients, first_moment, second_moment, visit_count, basis_sums, view_counts)
        # The coefficients have moved the mean colour by Σ Ȳ_k step_k; the shift of the colour takes that back.
        return state, -(basis_mean * step).sum(1)


class ShGroup:
    """Optimises a scene's spherical harmonics, and moves its colours with them.

    Args:
        coefficients: [N, K, 3] where the optimisation starts.
        shift_colors: moves the colours of the Gaussians by [N, 3].

    Attributes:
        state: present values.
    """

    def __init__(self, coefficients: Tensor, shift_colors: Callable[[Tensor], None]) -> None:
        self.state = ShState.from_coefficients(coefficients)
        self._shift_colors = shift_colors

    def contribute(self, auxiliary: AuxiliaryParameters) -> AuxiliaryParameters:
        """Adds the present coefficients to what is rendered."""
        return replace(auxiliary, spherical_harmonics=self.state.coefficients)

    def apply(self, gradients: Gradients, iteration: int, total: int) -> None:
        """Takes one step in the coefficients, and shifts the colours.

        Args:
            gradients: of this iteration; without a gradient of spherical harmonics nothing moves.
            iteration: from 0.
            total: T, the length of the schedule.
        """
        if gradients.spherical_harmonics is None:
            return
        # Colours are raw sRGB, so the gradient of their offsets is that of the colours themselves.
        by_colors = gradients.gaussians[:, 11:14]
        lr_scale = cosine_decay(iteration, total)
        self.state, shift = self.state.apply_step(gradients.spherical_harmonics, by_colors, lr_scale)
        self._shift_colors(shift)

    def write_back(self, scene: SceneGraph) -> SceneGraph:
        """Puts the present coefficients into a scene."""
        return scene.with_spherical_harmonics(self.state.coefficients)
