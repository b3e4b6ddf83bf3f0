"""A differentiable render by torch's autograd, on any device and in any precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from genre_tasks.optimiser.auxiliary import NO_AUXILIARY, AuxiliaryParameters
from genre_tasks.optimiser.gradients import Gradients, ShGradients, mark_drawn
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.render.api import compute_view_colors, render_views
from genre_tasks.render.motion_blur import PosedView
from genre_tasks.render.types import RenderSettings
from genre_tasks.scene.graph import FIRST_ACTOR


class AutogradRender:
    """Renders through autograd. It is the oracle of :class:`KernelRender` and the way on a GPU.

    Args:
        parameterization: the scene at its start, and the units of the offsets.
        offsets: [N, 14] from the start.
        views: V views of one image size, without motion blur.
        settings: the backend.
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
        scene = parameterization.scene
        deformation = auxiliary.deformation
        coefficients = auxiliary.spherical_harmonics
        # New leaves, so that the caller's tensors neither collect a gradient nor keep the graph of an iteration alive.
        self._offsets = offsets.detach().requires_grad_()
        # A scene that lists no actors is static, whatever its nodes say, as in ``SceneGraph.gaussians_at_frames``.
        self._is_actor = (scene.nodes >= FIRST_ACTOR) & bool(scene.actors)
        self._control_points = None if deformation is None else deformation.offsets.detach().requires_grad_()
        self._coefficients = None if coefficients is None else coefficients.detach().requires_grad_()
        # As a leaf inside the scene: interpolation in space and time is then autograd's work, not a formula of ours.
        if deformation is not None and self._control_points is not None:
            scene = replace(scene, deformation=deformation.with_offsets(self._control_points))
        # Whoever calls may have switched gradients off; the graph is needed all the same.
        with torch.enable_grad():
            scene = scene.with_gaussians(parameterization.gaussians_at(self._offsets))
            scene = scene.with_spherical_harmonics(self._coefficients)
            self._view_colors = None if coefficients is None else compute_view_colors(scene, views)
            image = render_views(scene, views, settings, self._view_colors)
            self._depth = image.expected_depth()
        self._color = image.color
        self.color = image.color.detach()
        self.depth = self._depth.detach()
        self.culled = image.culled

    def gradient(
        self, by_color: Tensor, by_depth: Tensor, residual: Tensor | None = None, view_weights: Tensor | None = None
    ) -> Gradients:
        """Takes the gradients of the images to those of the parameters, as :class:`DifferentiableRender` says."""
        # Before the backward pass below, which frees the graph that the residuals need too.
        image_residuals = None if residual is None else self._image_residuals(residual, view_weights)
        has_view_colors = self._view_colors is not None
        if self._view_colors is not None:
            self._view_colors.retain_grad()
        # The graph of the colours by view serves once more, for the sums of basis functions.
        torch.autograd.backward([self._color, self._depth], [by_color, by_depth], retain_graph=has_view_colors)
        assert self._offsets.grad is not None
        by_control_points = None if self._control_points is None else self._control_points.grad
        return Gradients(self._offsets.grad, by_control_points, self._sh_gradients(), image_residuals)

    def _sh_gradients(self) -> ShGradients | None:
        """The gradient of the coefficients, and the basis functions summed over the views that drew a Gaussian."""
        if self._view_colors is None or self._view_colors.grad is None or self._coefficients is None:
            return None
        # Colours are linear in coefficients: the derivative of their sum over views is the sum of basis functions.
        drawn = mark_drawn(self._view_colors.grad)
        view_counts, basis_sums = torch.autograd.grad(self._view_colors, (self._offsets, self._coefficients), drawn)
        assert self._coefficients.grad is not None
        return ShGradients(self._coefficients.grad, basis_sums, view_counts[:, 11:14])

    def _image_residuals(self, residual: Tensor, view_weights: Tensor | None) -> Tensor:
        """[N, 5], from the gradients of the colours: a pixel is linear in them, and the slope is the weight w."""
        # The renderer knows colours only: two of three channels carry the square and the weight.
        squared = residual.square().sum(-1)
        squared_and_weight = torch.stack([squared, torch.ones_like(squared), torch.zeros_like(squared)], -1)
        if view_weights is not None:
            weights = view_weights.to(squared)[:, None, None, None]
            residual = weights * residual
            squared_and_weight = weights * squared_and_weight
        # Colours by view are clamped at 0; the gradient of the offsets would be 0 there, and the weight is not.
        colors = self._offsets if self._view_colors is None else self._view_colors
        images = (residual, squared_and_weight)
        rgb, rest = (torch.autograd.grad(self._color, colors, image, retain_graph=True)[0] for image in images)
        sums = torch.cat([rgb[..., -3:], rest[..., -3:-1]], -1)
        return sums if self._view_colors is None else self._sum_over_frames(sums.sum(0))

    def _sum_over_frames(self, posed: Tensor) -> Tensor:
        """Sums [N, C] over the frames of values [N', C] that are laid out as ``SceneGraph.gaussians_at_frames``."""
        is_actor = self._is_actor
        static_count = int((~is_actor).sum())
        actor_count = int(is_actor.sum())
        out = posed.new_zeros((len(is_actor), posed.shape[1]))
        out[~is_actor] = posed[:static_count]
        # Frames lie one behind the other, each with all actors' Gaussians: that makes the sum a reshape.
        if actor_count:
            out[is_actor] = posed[static_count:].reshape(-1, actor_count, posed.shape[1]).sum(0)
        return out
