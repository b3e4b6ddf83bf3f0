"""One evaluation of the rendering loss, and its gradient with respect to everything that is optimised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from genre_tasks.config import LossConfig
from genre_tasks.losses.exposed_renders import ExposedRenders
from genre_tasks.losses.rendering_loss import ImageDistance, image_gradients, residual_image, select_loss_terms
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.auxiliary import NO_AUXILIARY, AuxiliaryParameters
from genre_tasks.optimiser.differentiable_render import render_differentiable
from genre_tasks.optimiser.gradients import Gradients
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.render.types import RenderSettings


@dataclass(frozen=True)
class LossAndGradients:
    """What one iteration learns from its views.

    Attributes:
        loss: of the batch.
        gradients: of the loss.
        culled: number of Gaussians that were left out of the renders, by reason.
    """

    loss: float
    gradients: Gradients
    culled: dict[str, int]


@dataclass(frozen=True)
class Objective:
    """The loss of paper Eq. 9–11 as a function of the parameters and a batch of views.

    Attributes:
        config: weights of the loss's terms.
        distance: the perceptual distance, or ``None`` to leave that term out.
        settings: how to render.
    """

    config: LossConfig
    distance: ImageDistance | None = None
    settings: RenderSettings = field(default_factory=RenderSettings)

    def evaluate(
        self,
        parameterization: Parameterization,
        offsets: Tensor,
        targets: Sequence[Target],
        iteration: int,
        generator: torch.Generator,
        auxiliary: AuxiliaryParameters = NO_AUXILIARY,
        image_residuals: bool = False,
    ) -> LossAndGradients:
        """Renders the views of a batch, and compares them with their images.

        Args:
            parameterization: the scene at its start, and the units of the offsets.
            offsets: [N, 14] from the start.
            targets: the batch.
            iteration: from 0; it decides whether the perceptual term is taken.
            generator: it draws the perceptual term's crops.
            auxiliary: present values of the other parameters.
            image_residuals: whether the gradients shall have image residuals.

        Returns:
            LossAndGradients: with respect to the offsets and to what ``auxiliary`` has.

        Raises:
            NonFiniteError: a camera is not finite.
            ResourceError: a kernel is not compiled, or memory does not suffice.
        """
        # Drawn before anything is rendered, so that a seed means the same crops with any backend.
        terms = select_loss_terms(self.config, targets, iteration, generator, self.distance is not None)
        # No gradient mode is set here: a render by autograd makes its own graph, and one by kernels needs none.
        render = render_differentiable(parameterization, offsets, targets, self.settings, auxiliary)
        exposed = ExposedRenders.from_renders(render.color, targets)
        loss, by_color, by_depth = image_gradients(self.config, exposed, render.depth, terms, self.distance)
        # Before ``gradient``, which uses up the render's tensors.
        residual = residual_image(exposed) if image_residuals else None
        return LossAndGradients(loss, render.gradient(by_color, by_depth, residual), render.culled)
