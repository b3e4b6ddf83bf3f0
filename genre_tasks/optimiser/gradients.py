"""The gradient of a loss with respect to everything that one optimisation moves."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from genre_tasks.checks import check_finite

WEIGHTED_RESIDUAL_RGB = slice(0, 3)
WEIGHTED_SQUARED_RESIDUAL = slice(3, 4)
TOTAL_WEIGHT = slice(4, 5)
"""Columns of image residuals [N, 5].

With r the difference between image and render at a pixel and w the blending weight of a Gaussian there, they are the
sums over all pixels of w r, of w ‖r‖² and of w.
"""


@dataclass(frozen=True)
class ShGradients:
    """The gradient of spherical-harmonics coefficients, and the directions in which views looked.

    Attributes:
        coefficients: [N, K, 3] gradient with respect to the coefficients.
        basis_sums: [N, K, 3] basis functions, summed over the views in which the Gaussian has a gradient.
        view_counts: [N, 3] how many views these are.
    """

    coefficients: Tensor
    basis_sums: Tensor
    view_counts: Tensor


@dataclass(frozen=True)
class Gradients:
    """What one differentiable render returns for the gradients of its images.

    Attributes:
        gaussians: [N, 14] gradient with respect to the offsets of the packed attributes.
        deformation: [A, K, NODES, 3] gradient with respect to the control points; ``None`` where actors are rigid.
        spherical_harmonics: gradient of the coefficients; ``None`` where each Gaussian has one colour for all views.
        image_residuals: [N, 5] what each Gaussian shows of the residual image; ``None`` unless one was given.
    """

    gaussians: Tensor
    deformation: Tensor | None = None
    spherical_harmonics: ShGradients | None = None
    image_residuals: Tensor | None = None

    def check_finite(self, stage: str) -> None:
        """Stops an optimisation before a broken gradient reaches any parameter.

        Args:
            stage: name of the stage, for the message.

        Raises:
            NonFiniteError: a gradient has NaN or infinity; it names the tensor and its first such entry.
        """
        # The Gaussians first: a broken renderer shows there, and the other gradients follow from it.
        check_finite(self.gaussians, "gradient", stage)
        if self.deformation is not None:
            check_finite(self.deformation, "gradient of the deformation", stage)
        if self.spherical_harmonics is not None:
            check_finite(self.spherical_harmonics.coefficients, "gradient of spherical harmonics", stage)


def mark_drawn(by_colors: Tensor) -> Tensor:
    """Marks the Gaussians that each view has drawn.

    Args:
        by_colors: [V, N, 3] gradient with respect to the colour of each Gaussian in each view.

    Returns:
        [V, N, 3], 1 in all three channels where any of them has a gradient, else 0.

    >>> import torch
    >>> mark_drawn(torch.tensor([[[0.0, -2.0, 0.0], [0.0, 0.0, 0.0]]])).tolist()
    [[[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]]
    """
    # The renderer keeps no record of what it drew. A drawn Gaussian with a gradient of exactly 0 in all channels
    # would be missed, which costs it one view in a mean over many.
    red, green, blue = (by_colors != 0).unbind(-1)
    # Not ``any``: torch is several times as slow where it reduces three entries at a time.
    drawn = (red | green | blue).to(by_colors.dtype)
    return drawn[..., None].expand_as(by_colors).contiguous()
