"""A differentiable render of views with motion blur, from one of several moments of their exposure."""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.optimiser.autograd_render import AutogradRender
from genre_tasks.optimiser.gradients import Gradients
from genre_tasks.optimiser.kernel_render import KernelRender
from genre_tasks.render.motion_blur import BlurSamples, mean_in_linear_light, mean_in_linear_light_gradient
from genre_tasks.threads import map_single_threaded


class MotionBlurRender:
    """Brings the images of moments together, and takes the gradients of their means apart.

    Args:
        sharp: the render of all moments.
        samples: which moments belong to which view.

    Attributes:
        color: [V, H, W, 3] the mean over the moments in linear light.
        depth: [V, H, W] that of the moment at each pose's time, to which LiDAR returns belong.
        culled: as in :class:`DifferentiableRender`, over all moments.
    """

    def __init__(self, sharp: KernelRender | AutogradRender, samples: BlurSamples) -> None:
        self._sharp = sharp
        self._samples = samples
        # A view at a time on one thread: the powers of the sRGB curve round differently where threads' pieces end.
        images = map_single_threaded(lambda part: mean_in_linear_light(sharp.color[part]), samples.parts)
        self.color = torch.stack(images)
        # LiDAR measured the surface at the pose's time, and not its mean over the exposure.
        self.depth = sharp.depth[samples.middle_indices]
        self.culled = sharp.culled

    def gradient(
        self, by_color: Tensor, by_depth: Tensor, residual: Tensor | None = None, view_weights: Tensor | None = None
    ) -> Gradients:
        """Takes the gradients of the images to those of the parameters, as :class:`DifferentiableRender` says.

        Each moment of a view takes the view's residual, and an equal fraction of the view's weight.
        """
        sharp = self._sharp
        parts = self._samples.parts

        def split_gradient(view: int) -> Tensor:
            return mean_in_linear_light_gradient(sharp.color[parts[view]], by_color[view])

        by_moments = torch.cat(map_single_threaded(split_gradient, range(len(parts))))
        by_depths = torch.zeros_like(sharp.depth)
        by_depths[self._samples.middle_indices] = by_depth
        if residual is not None:
            # A sharp view among blurred ones counts as one moment, so weights differ from view to view.
            counts = torch.tensor([part.stop - part.start for part in parts])
            weights = torch.ones(len(parts)) if view_weights is None else view_weights
            residual = residual.repeat_interleave(counts.to(residual.device), 0)
            per_moment = weights / counts
            view_weights = per_moment.repeat_interleave(counts.to(per_moment.device), 0)
        return sharp.gradient(by_moments, by_depths, residual, view_weights)
