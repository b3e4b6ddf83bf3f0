"""The Brown–Conrady lens model of normalised image coordinates: where a ray arrives, and how fast that changes.

Coefficients are k1, k2, p1, p2, k3 throughout, as in ``Lens.coefficients``. Normalised coordinates are x/z and y/z of a
ray in camera axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

Numbers = TypeVar("Numbers", "NDArray[np.floating]", "Tensor")


def distort(x: Numbers, y: Numbers, coefficients: Sequence[Any]) -> tuple[Numbers, Numbers]:
    """Bends rays as the lens does; differentiable for tensors.

    Args:
        x: normalised image coordinates of any shape.
        y: of the same shape.
        coefficients: k1, k2, p1, p2, k3: numbers or tensors.

    Returns:
        x' and y' in the precision of the input.

    >>> x, y = distort(np.array([0.5]), np.array([0.0]), (-0.2, 0.0, 0.0, 0.0, 0.0))
    >>> float(x[0]), float(y[0])
    (0.475, 0.0)
    """
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def distortion_jacobian(x: Numbers, y: Numbers, coefficients: Sequence[Any]) -> tuple[Numbers, Numbers, Numbers]:
    """Computes the slopes of :func:`distort`.

    The Jacobian is symmetric, since the distortion is the gradient of a potential: ∂y'/∂x is ∂x'/∂y.

    Args:
        x: normalised image coordinates of any shape.
        y: of the same shape.
        coefficients: k1, k2, p1, p2, k3.

    Returns:
        ∂x'/∂x, ∂x'/∂y and ∂y'/∂y.
    """
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
    return (
        radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
        2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
        radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )
