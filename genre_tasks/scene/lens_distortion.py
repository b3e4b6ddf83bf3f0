"""Brown–Conrady lens distortion on normalised image coordinates: there, its slopes, back, and where it ends.

Coefficients are k1, k2, p1, p2, k3: ``Lens.coefficients``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.types import Float64, Lens

if TYPE_CHECKING:
    from torch import Tensor

Reals = NDArray[np.floating]
Numbers = TypeVar("Numbers", "NDArray[np.floating]", "Tensor")
_NEWTON_STEPS, _CONVERGED = 25, 1e-14


def distort(x: Numbers, y: Numbers, coefficients: Sequence[Any]) -> tuple[Numbers, Numbers]:
    """Normalised image coordinates as the lens bends them, in their precision; tensors with their gradients."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def slopes(x: Numbers, y: Numbers, coefficients: Sequence[Any]) -> tuple[Numbers, Numbers, Numbers]:
    """∂x'/∂x, ∂x'/∂y and ∂y'/∂y of :func:`distort`; ∂y'/∂x is ∂x'/∂y: the distortion is a potential's gradient."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + r2 * 3 * k3)
    return (
        radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
        2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
        radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )


def fold_radius(coefficients: Sequence[float]) -> float:
    """The radius at which d(r · radial)/dr first is 0: rays beyond come back into the image. ``inf`` where it never is.

    The tangential terms, which are small in any lens, are not looked at.
    """
    k1, k2, _, _, k3 = coefficients
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    squares = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(squares.min())) if len(squares) else np.inf


def undistort(x: Float64, y: Float64, coefficients: Sequence[float]) -> tuple[Float64, Float64]:
    """The inverse of :func:`distort` within the fold radius, by Newton's method in float64.

    Where no ray of the lens arrives, the result is on the fold radius.
    """
    most = fold_radius(coefficients)

    def limited(u: Float64, v: Float64) -> tuple[Float64, Float64]:
        shrink = np.minimum(1.0, most / np.maximum(np.hypot(u, v), 1e-30))
        return u * shrink, v * shrink

    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    u, v = limited(x, y)
    for _ in range(_NEWTON_STEPS):
        found_x, found_y = distort(u, v, coefficients)
        off_x, off_y = found_x - x, found_y - y
        if max(np.abs(off_x).max(initial=0.0), np.abs(off_y).max(initial=0.0)) < _CONVERGED:
            break
        xx, xy, yy = slopes(u, v, coefficients)
        det = np.maximum(xx * yy - xy * xy, 1e-6)  # 0 on the fold
        u, v = limited(u - (yy * off_x - xy * off_y) / det, v - (xx * off_y - xy * off_x) / det)
    return u, v


def rays_at(u: Float64, v: Float64, lens: Lens) -> tuple[Float64, Float64]:
    """x/z and y/z of the rays that arrive at pixels (u, v)."""
    x, y = (u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px
    return undistort(x, y, lens.coefficients) if any(lens.distortion) else (x, y)
