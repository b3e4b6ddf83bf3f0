"""Brown–Conrady lens distortion of normalised image coordinates: forward, its slopes, inverse, and where it ends.

Coefficients are k1, k2, p1, p2, k3 throughout, as in ``Lens.coefficients``. Normalised coordinates are x/z and y/z of a
ray in camera axes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.brown_conrady import distort, distortion_jacobian
from genre_tasks.logs.types import Float64, Lens

Reals = NDArray[np.floating]
_NEWTON_STEPS = 25
_CONVERGED = 1e-14
# Images that are farther off than this, which is far less than a pixel, tell that Newton's method has not converged.
_FAILED = 1e-9
_BISECTIONS = 50


def fold_radius(coefficients: Sequence[float]) -> float:
    """Finds where a lens folds back: the radius at which d(r · radial)/dr first is 0.

    Rays beyond it would come back into the image. The tangential terms, small in any lens, are left out.

    Args:
        coefficients: k1, k2, p1, p2, k3.

    Returns:
        The radius in normalised coordinates, ``inf`` for a lens that never folds.

    >>> fold_radius((0.1, 0.0, 0.0, 0.0, 0.0))
    inf
    >>> round(fold_radius((-1 / 3, 0.0, 0.0, 0.0, 0.0)), 6)
    1.0
    """
    k1, k2, _, _, k3 = coefficients
    # d(r · radial)/dr is a cubic in r².
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    # The roots are numerical: a real double root comes with a tiny imaginary part.
    squares = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(squares.min())) if len(squares) else np.inf


def undistort(x: Float64, y: Float64, coefficients: Sequence[float]) -> tuple[Float64, Float64]:
    """Inverts :func:`distort` within the fold radius, by Newton's method in float64.

    Where it does not converge from the distorted point, it starts again from the inverse of the radial terms.

    Args:
        x: distorted normalised image coordinates of any shape.
        y: of the same shape.
        coefficients: k1, k2, p1, p2, k3.

    Returns:
        Undistorted coordinates; on the fold radius where no ray of the lens arrives.

    >>> x, y = undistort(np.array([0.475]), np.array([0.0]), (-0.2, 0.0, 0.0, 0.0, 0.0))
    >>> round(float(x[0]), 12)
    0.5
    """
    radius = fold_radius(coefficients)
    x = np.asarray(x, np.float64)
    y = np.asarray(y, np.float64)
    # The distorted point is near enough as a start for nearly all points of nearly all lenses.
    u, v = _run_newton(x, y, x, y, coefficients, radius)
    failed = _distances(u, v, x, y, coefficients) > _FAILED
    if not failed.any():
        return u, v
    # The radial inverse is nearer than that, and costs more. Points that fail from there too have no ray.
    u = np.array(u)
    v = np.array(v)
    x = x[failed]
    y = y[failed]
    again = _run_newton(*_invert_radially(x, y, coefficients, radius), x, y, coefficients, radius)
    found = _distances(*again, x, y, coefficients) <= _FAILED
    u[failed] = np.where(found, again[0], u[failed])
    v[failed] = np.where(found, again[1], v[failed])
    return u, v


def _run_newton(
    u: Float64, v: Float64, x: Float64, y: Float64, coefficients: Sequence[float], radius: float
) -> tuple[Float64, Float64]:
    """Newton's method from the undistorted points (u, v), within the fold radius, for the distorted points (x, y)."""

    def limit(u: Float64, v: Float64) -> tuple[Float64, Float64]:
        # Beyond the fold Newton's method would run to a solution that no ray of the lens has.
        shrink = np.minimum(1.0, radius / np.maximum(np.hypot(u, v), 1e-30))
        return u * shrink, v * shrink

    u, v = limit(u, v)
    for _ in range(_NEWTON_STEPS):
        found_x, found_y = distort(u, v, coefficients)
        error_x = found_x - x
        error_y = found_y - y
        # An initial value, because the largest of no points would raise.
        if max(np.abs(error_x).max(initial=0.0), np.abs(error_y).max(initial=0.0)) < _CONVERGED:
            break
        xx, xy, yy = distortion_jacobian(u, v, coefficients)
        # The determinant is 0 on the fold, where a step would have no end.
        det = np.maximum(xx * yy - xy * xy, 1e-6)
        u, v = limit(u - (yy * error_x - xy * error_y) / det, v - (xx * error_y - xy * error_x) / det)
    return u, v


def _distances(u: Float64, v: Float64, x: Float64, y: Float64, coefficients: Sequence[float]) -> Float64:
    """How far the images of undistorted points (u, v) are from the distorted points (x, y)."""
    found_x, found_y = distort(u, v, coefficients)
    return np.asarray(np.hypot(found_x - x, found_y - y), np.float64)


def _invert_radially(x: Float64, y: Float64, coefficients: Sequence[float], radius: float) -> tuple[Float64, Float64]:
    """Undistorted points without the tangential terms, by bisection up to the fold radius."""
    k1, k2, _, _, k3 = coefficients
    target = np.hypot(x, y)

    def image_radius(r: Float64) -> Float64:
        return r * (1 + r**2 * (k1 + r**2 * (k2 + r**2 * k3)))

    low = np.zeros_like(target)
    high = np.full_like(target, radius if np.isfinite(radius) else 1.0)
    # A lens that never folds has images at any radius: the bound grows until it is beyond all points.
    while not np.isfinite(radius) and (image_radius(high) < target).any():
        high *= 2
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        beyond = image_radius(middle) > target
        low = np.where(beyond, low, middle)
        high = np.where(beyond, middle, high)
    scale = low / np.maximum(target, 1e-30)
    return x * scale, y * scale


def pixels_to_rays(u: Float64, v: Float64, lens: Lens) -> tuple[Float64, Float64]:
    """Finds the rays that arrive at pixels, distortion included.

    Args:
        u: columns in pixels, of any shape; the first pixel's centre is at 0.5.
        v: rows, of the same shape.
        lens: of the camera.

    Returns:
        x/z and y/z of the rays in camera axes.
    """
    x = (u - lens.cx_px) / lens.fx_px
    y = (v - lens.cy_px) / lens.fy_px
    # Images of many logs are rectified already, and need no Newton steps.
    return undistort(x, y, lens.coefficients) if any(lens.distortion) else (x, y)
