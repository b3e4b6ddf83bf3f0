"""A differentiable render by compiled kernels: float32 on the CPU.

Torch's autograd around the renderer would cost as much as two views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from genre_tasks.optimiser.auxiliary import NO_AUXILIARY, AuxiliaryParameters
from genre_tasks.optimiser.gradients import Gradients, ShGradients, mark_drawn
from genre_tasks.optimiser.kernels import posing
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.render import cpu
from genre_tasks.render.api import build_cameras, compute_actor_velocities, compute_view_colors
from genre_tasks.render.motion_blur import PosedView
from genre_tasks.render.types import RenderSettings

if TYPE_CHECKING:
    from genre_tasks.optimiser.deformed_means import DeformedMeans
    from genre_tasks.scene.deformation import Deformation


class KernelRender:
    """Renders by kernels alone; :class:`AutogradRender` is its oracle.

    Args:
        parameterization: the scene at its start, and the units of the offsets.
        offsets: [N, 14] from the start.
        views: V views of one image size, without motion blur.
        settings: the number of threads; ``None`` there takes torch's.
        auxiliary: present values of the other parameters.

    Attributes:
        color: as in :class:`DifferentiableRender`.
        depth: as there.
        culled: as there.
    """

    def __init__(
        self,
        parameterization: Parameterization,
        offsets: Tensor,
        views: Sequence[PosedView],
        settings: RenderSettings,
        auxiliary: AuxiliaryParameters = NO_AUXILIARY,
    ) -> None:
        offsets = offsets.detach()
        frames = [view.frame for view in views]
        # Views at one frame share splats: actors are posed once for each frame and not for each view.
        distinct_frames = list(dict.fromkeys(frames))
        self._threads = settings.threads or torch.get_num_threads()
        self._posing = parameterization.posing
        self._posed = self._posing.pose(offsets, distinct_frames, self._threads)
        self._splats = self._posed.splats
        means = self._splats[0]
        # In place and before velocities are taken, which depend on where a mean is.
        self._deformed_means = _deform(parameterization, offsets, distinct_frames, means, auxiliary.deformation)
        velocities = compute_actor_velocities(parameterization.scene, means, views)
        self._sh_colors: ShColors | None = None
        if auxiliary.spherical_harmonics is not None:
            self._sh_colors = ShColors(parameterization, offsets, auxiliary.spherical_harmonics, views)
            self._splats = (*self._splats[:4], self._sh_colors.colors.detach())
        # ``keep``: the kernel keeps the sorted splats of each tile, or the way back would have to sort them again.
        self._images, self.culled, self._batch = cpu.forward(
            self._splats,
            build_cameras(views, parameterization.scene.antialiased),
            self._posing.visible_ranges(frames),
            self._threads,
            keep=True,
            velocities=velocities,
        )
        self.color, self._alpha, summed_depth = self._images
        self.depth = posing.expected_depth(self._alpha, summed_depth)

    def gradient(
        self, by_color: Tensor, by_depth: Tensor, residual: Tensor | None = None, view_weights: Tensor | None = None
    ) -> Gradients:
        """Takes the gradients of the images to those of the parameters, as :class:`DifferentiableRender` says."""
        # Written over ``self.depth`` and ``by_depth``, which is why this method may be called once only.
        by_alpha, by_depth = posing.expected_depth_gradient(self._alpha, self.depth, by_depth.contiguous())
        by_splats = posing.allocate_splats(len(self._posed.splats[0]))
        by_colors = by_splats[4]
        if self._sh_colors is not None:
            # Colours differ from view to view: their gradient goes to the coefficients, and none to the splats.
            by_colors = torch.empty_like(self._splats[4])
            by_splats[4].zero_()
        assert self._batch is not None
        # Residuals are summed in the same pass over the pixels, where the blending weights are at hand.
        splat_residuals = cpu.backward(
            self._batch,
            self._splats,
            self._images,
            (by_color, by_alpha, by_depth),
            self._threads,
            (*by_splats[:4], by_colors),
            residual,
            view_weights,
        )
        by_offsets = self._posing.offsets_gradient(self._posed, by_splats, self._threads)
        by_coefficients: ShGradients | None = None
        if self._sh_colors is not None:
            by_means, by_base_colors, by_coefficients = self._sh_colors.gradient(by_colors)
            by_offsets[:, 0:3] += by_means
            by_offsets[:, 11:14] += by_base_colors
        image_residuals: Tensor | None = None
        if splat_residuals is not None:
            image_residuals = self._posing.gather_residuals(self._posed, splat_residuals, self._threads)
        # After the sums above: it adds to the same rows of ``by_offsets``.
        by_control_points: Tensor | None = None
        if self._deformed_means is not None:
            by_control_points = self._deformed_means.gradient(by_splats[0], by_offsets)
        return Gradients(by_offsets, by_control_points, by_coefficients, image_residuals)


class ShColors:
    """Colours that views see of a scene with spherical harmonics, and their gradient, by torch's autograd.

    Args:
        parameterization: the scene at its start, and the units of the offsets.
        offsets: [N, 14] from the start.
        coefficients: [N, K, 3].
        views: V views.

    Attributes:
        colors: [V, N', 3], laid out as ``SceneGraph.gaussians_at_frames``.
    """

    def __init__(
        self, parameterization: Parameterization, offsets: Tensor, coefficients: Tensor, views: Sequence[PosedView]
    ) -> None:
        gaussians = parameterization.gaussians_at(offsets)
        # Of the 14 attributes only means (by directions) and colours matter here: autograd sees no other.
        means = gaussians.means.detach().requires_grad_()
        base_colors = gaussians.colors.detach().requires_grad_()
        coefficients = coefficients.detach().requires_grad_()
        self._unit_m = parameterization.unit_m
        self._inputs = (means, base_colors, coefficients)
        with torch.enable_grad():
            gaussians = replace(gaussians, means=means, colors=base_colors)
            scene = parameterization.scene.with_gaussians(gaussians).with_spherical_harmonics(coefficients)
            self.colors = compute_view_colors(scene, views)

    def gradient(self, by_colors: Tensor) -> tuple[Tensor, Tensor, ShGradients]:
        """Takes the gradient of the colours [V, N', 3] back to what they were made of.

        Args:
            by_colors: [V, N', 3].

        Returns:
            tuple: the gradients with respect to the offsets of means [N, 3] and of colours [N, 3], and
            :class:`ShGradients`.
        """
        by_means, by_base_colors, by_coefficients = torch.autograd.grad(
            self.colors, self._inputs, by_colors, retain_graph=True
        )
        # Colours are linear in coefficients: the derivative of their sum over views is the sum of basis functions.
        _, view_counts, basis_sums = torch.autograd.grad(self.colors, self._inputs, mark_drawn(by_colors))
        # Means were leaves in metres; offsets of means are in units.
        return by_means * self._unit_m, by_base_colors, ShGradients(by_coefficients, basis_sums, view_counts)


def _deform(
    parameterization: Parameterization,
    offsets: Tensor,
    frames: Sequence[float],
    means: Tensor,
    deformation: Deformation | None,
) -> DeformedMeans | None:
    """Moves the splats' ``means`` in place as actors deform; ``None`` where actors are rigid."""
    if deformation is None:
        return None
    # A scene without deforming actors loads nothing of them.
    from genre_tasks.optimiser.deformed_means import DeformedMeans

    return DeformedMeans(parameterization, offsets, frames, means, deformation)
