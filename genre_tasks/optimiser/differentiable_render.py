"""One render of the Gaussians and its gradient with respect to their offsets: by kernels, or by torch's autograd.

Names that begin with ``by_`` are gradients of the loss: ``by_color`` is its gradient with respect to ``color``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from genre_tasks.optimiser.autograd_render import AutogradRender
from genre_tasks.optimiser.auxiliary import NO_AUXILIARY, AuxiliaryParameters
from genre_tasks.optimiser.gradients import Gradients
from genre_tasks.optimiser.kernel_render import KernelRender
from genre_tasks.optimiser.kernels.library import is_supported
from genre_tasks.optimiser.motion_blur_render import MotionBlurRender
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.render.motion_blur import BlurSamples, PosedView
from genre_tasks.render.types import RenderSettings


class DifferentiableRender(Protocol):
    """The images of V views, and one way back from them to the parameters.

    Attributes:
        color: [V, H, W, 3] sRGB.
        depth: [V, H, W] expected depth in metres, 0 where nothing was rendered.
        culled: number of Gaussians that were left out, by reason, as in ``Render``.
    """

    color: Tensor
    depth: Tensor
    culled: dict[str, int]

    def gradient(
        self, by_color: Tensor, by_depth: Tensor, residual: Tensor | None = None, view_weights: Tensor | None = None
    ) -> Gradients:
        """Takes the gradients of the images to those of the parameters.

        It may be called once, and it uses up the tensors that it is given.

        Args:
            by_color: [V, H, W, 3].
            by_depth: [V, H, W].
            residual: [V, H, W, 3] image less render, for ``Gradients.image_residuals``; ``None``: they are not taken.
            view_weights: [V] float32, how much each view counts in the image residuals; ``None``: 1 each.

        Returns:
            Gradients: with respect to the offsets and to the auxiliary parameters that were rendered.
        """
        ...


def render_differentiable(
    parameterization: Parameterization,
    offsets: Tensor,
    views: Sequence[PosedView],
    settings: RenderSettings,
    auxiliary: AuxiliaryParameters = NO_AUXILIARY,
) -> DifferentiableRender:
    """Renders views such that a loss on the images can be differentiated.

    Args:
        parameterization: the scene at its start, and the units of the offsets.
        offsets: [N, 14] from the start.
        views: V views of one image size; those with motion blur are rendered as several moments of their exposure.
        settings: the backend. ``auto`` and ``cpu`` take the kernels for float32 on the CPU.
        auxiliary: present values of the other parameters.

    Returns:
        DifferentiableRender: :class:`KernelRender` where the kernels support the tensors, else
        :class:`AutogradRender`; a :class:`MotionBlurRender` of either where a view has motion blur.

    Raises:
        NonFiniteError: a camera is not finite.
        ResourceError: the kernels are not compiled, or memory does not suffice.
    """
    # All three decide: a scene in float64, as the oracles have it, must not reach a kernel for float32.
    tensors = (offsets, parameterization.initial, parameterization.unit_m)
    by_kernels = settings.backend in ("auto", "cpu") and is_supported(*tensors)
    render_sharp: type[KernelRender] | type[AutogradRender] = KernelRender if by_kernels else AutogradRender
    # Motion blur is resolved here, so that both kinds of render see sharp views only.
    samples = BlurSamples.from_views(views)
    if samples is None:
        return render_sharp(parameterization, offsets, views, settings, auxiliary)
    return MotionBlurRender(render_sharp(parameterization, offsets, samples.views, settings, auxiliary), samples)
