"""One evaluation of the rendering loss and its gradient with respect to the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from genre_tasks.config import LossConfig
from genre_tasks.losses.rendering_loss import Distance, image_gradients, plan_loss, residual_image
from genre_tasks.losses.targets import Target
from genre_tasks.optimiser.differentiable_render import RIGID_AND_DULL, Beside, begin
from genre_tasks.optimiser.state import Frame
from genre_tasks.render.types import RenderSettings

if TYPE_CHECKING:
    from genre_tasks.optimiser.sh_optimiser import GlossSight


@dataclass(frozen=True)
class Sight:
    """What an iteration sees: the loss, its gradient [N, 14] with respect to the offsets, and culled Gaussians.

    ``by_deformation``: as its ``offsets``, where actors deform. ``residuals``: as a ``Pass`` has them, where asked for.
    """

    loss: float
    gradient: Tensor
    culled: dict[str, int]
    by_deformation: Tensor | None = None
    gloss: GlossSight | None = None
    residuals: Tensor | None = None


@dataclass(frozen=True)
class Objective:
    """The loss of paper Eq. 9–11 as a function of the offsets and a batch of views.

    ``distance`` is the perceptual distance, or ``None`` to leave that term out.
    """

    config: LossConfig
    distance: Distance | None = None
    settings: RenderSettings = field(default_factory=RenderSettings)

    def __call__(
        self,
        frame: Frame,
        offsets: Tensor,  # [N, 14]
        targets: Sequence[Target],
        iteration: int,
        generator: torch.Generator,
        beside: Beside = RIGID_AND_DULL,
        residuals: bool = False,
    ) -> Sight:
        """``iteration`` and ``generator`` decide where the perceptual term is taken; ``residuals``: see ``Sight``."""
        plan = plan_loss(self.config, targets, iteration, generator, self.distance is not None)
        image = begin(frame, offsets, targets, self.settings, beside)
        loss, by_color, by_depth = image_gradients(self.config, image.color, image.depth, targets, plan, self.distance)
        gradient = image.gradient(by_color, by_depth, residual_image(image.color, targets) if residuals else None)
        return Sight(loss, gradient, image.culled, image.by_deformation, image.gloss, image.residuals)
