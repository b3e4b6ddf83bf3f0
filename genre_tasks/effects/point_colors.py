"""Colours of LiDAR points in several images, and what of their differences exposure and haze explain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.logs.types import Float32, Float64
from genre_tasks.scene.chunk import View
from genre_tasks.threads import multiply_transposed, torch_threads

MIN_SHARED_POINTS = 10
"""An image's gain is known where it shares at least so many points with other images."""

DARKEST = 8.0 / 255
"""Below it a pixel is mostly noise, and its logarithm says nothing of the gain."""

BRIGHTEST = 247.0 / 255
"""Above it a pixel is clipped."""

_ITERATIONS = 12
_SMALLEST = 1e-6
# Residuals of log colour from here on count less and less: wrong pixels, reflections, moving shadows.
_OUTLIER = 0.1
# Of a point with more texture than this, the colour says ever less of the gain.
_TEXTURE = 0.1


@dataclass(frozen=True)
class PointColors:
    """Colours of P static points in V images.

    Attributes:
        views: the V views.
        log_color: [V, P, 3] logarithm of linear colour; NaN where a view does not see the point, or sees it clipped or
            dark.
        texture: [V, P] standard deviation of the same within 3 × 3 pixels, mean over channels.
        distance_m: [V, P] metres along the camera's axis.
    """

    views: tuple[View, ...]
    log_color: Float64
    texture: Float64
    distance_m: Float64

    @property
    def shared(self) -> NDArray[np.bool_]:
        """[V, P] true where the view sees the point, and at least one other view does."""
        visible = np.isfinite(self.log_color).all(2)
        return visible & (visible.sum(0) >= 2)


@dataclass(frozen=True)
class GainEstimate:
    """What explains the colours of shared points.

    Attributes:
        log_gain: [V, 3] each view's gain, of mean zero over the views that share ``MIN_SHARED_POINTS`` with others.
        haze_per_m: strength of haze per metre, at least 0.
        residual: [V, P, 3] what neither a point's own colour, nor gain, nor haze explains; NaN where not observed.
    """

    log_gain: Float64
    haze_per_m: float
    residual: Float64


def estimate_gains_and_haze(
    log_color: Float64,  # [V, P, 3]
    distance_m: Float64,  # [V, P]
    texture: Float64,  # [V, P]
    observed: NDArray[np.bool_],  # [V, P]
    sky_color: Float64,  # [3]
) -> GainEstimate:
    """Separates what a camera's exposure does to a colour from what haze does, using points seen in several views.

    The model, per channel::

        log I[v, p] = log c[p] + g[v] + log(1 + h * d[v, p] * (s / c[p] - 1))

    with c the point's own colour, g the view's log gain, d the distance, s the colour of the sky and h >= 0 one haze
    strength for all channels. It is solved by Gauss-Newton with reweighting, so that moving objects and wrong pixels
    count little.

    Points with much texture count little too. From far away, a pixel mixes a leaf or an edge with what is around it,
    and that would pass for haze.

    Args:
        log_color: logarithm of the linear colour of point p in view v; any finite value where not observed.
        distance_m: from the camera to the point.
        texture: as in ``PointColors``; any value where not observed.
        observed: the view sees the point, and at least one other view does.
        sky_color: linear colour of the sky, which distant haze looks like.

    Returns:
        Gains, haze and residuals.

    >>> gain = np.array([-0.2, 0.2])
    >>> log_color = np.log(0.5) + np.zeros((2, 30, 3)) + gain[:, None, None]
    >>> smooth, seen = np.zeros((2, 30)), np.ones((2, 30), bool)
    >>> found = estimate_gains_and_haze(log_color, np.zeros((2, 30)), smooth, seen, np.ones(3))
    >>> np.allclose(found.log_gain, gain[:, None])
    True
    """
    light = log_color.transpose(2, 0, 1)  # [3, V, P]
    # Zero instead of NaN where nothing is observed.
    reliability = observed / np.square(1 + np.square(np.where(observed, texture, 0.0) / _TEXTURE))
    weight = reliability
    point_color = _mean_over_views(light, weight)
    log_gain = np.zeros((3, len(observed), 1))
    haze = 0.0
    # One haze for all channels: with a number each it could trade a drift of gain for haze as the vehicle drives ahead.
    for _ in range(_ITERATIONS):
        excess = distance_m * (sky_color[:, None, None] * np.exp(-point_color) - 1)
        # A guard for points that are brighter than the sky and far away: the model would make their light negative.
        hazed = np.maximum(1 + haze * excess, _SMALLEST)
        haze_slope = excess / hazed
        target = light - np.log(hazed) + haze * haze_slope
        target = target - _mean_over_views(target, weight)
        haze_slope = haze_slope - _mean_over_views(haze_slope, weight)
        haze, log_gain = _solve_normal_equations(target, haze_slope, weight)
        haze_term = np.log(np.maximum(1 + haze * excess, _SMALLEST))
        point_color = _mean_over_views(light - log_gain - haze_term, weight)
        residual = light - log_gain - haze_term - point_color
        # Cauchy weights, one for all channels: a wrong pixel is wrong in all of them.
        weight = reliability / (1 + np.square(residual / _OUTLIER).mean(0))
    gains = log_gain[..., 0].T
    linked = find_linked_views(observed)
    # A gain common to all views cannot be told from the scene's own brightness: zero mean is a convention.
    gains -= gains[linked].mean(0) if linked.any() else 0
    return GainEstimate(gains, haze, np.where(observed[..., None], residual.transpose(1, 2, 0), np.nan))


def _solve_normal_equations(target: Float64, haze_slope: Float64, weight: Float64) -> tuple[float, Float64]:
    """Solves one weighted least-squares step for the haze and for the gains [3, V, 1].

    Both inputs [3, V, P] have had their mean over views removed, which eliminates the points' own colours.
    """
    # Views are coupled by the points that they share. The system has one freedom left, a gain common to all views, so
    # that it takes a pseudo-inverse.
    share = weight / np.maximum(weight.sum(0), _SMALLEST)
    gain_target = (weight * target).sum(2)  # [3, V]
    gain_haze = (weight * haze_slope).sum(2)  # [3, V]
    # By torch on one thread: NumPy's products and decompositions have other last bits at each number of threads.
    with torch_threads(1):
        coupling = multiply_transposed(share.T, weight.T)
        inverse = torch.linalg.pinv(torch.from_numpy(np.diag(weight.sum(1)) - coupling)).numpy()
    numerator = (weight * haze_slope * target).sum() - np.einsum("cv,vw,cw->", gain_haze, inverse, gain_target)
    denominator = (weight * haze_slope**2).sum() - np.einsum("cv,vw,cw->", gain_haze, inverse, gain_haze)
    haze = max(0.0, float(numerator / max(denominator, _SMALLEST)))
    # By einsum, whose sums do not depend on threads as those of a product do.
    log_gain = np.einsum("cv,vw->cw", gain_target - haze * gain_haze, inverse)[..., None]
    return haze, log_gain


def find_linked_views(observed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Finds the views that share enough points with others for their gain to be known.

    Args:
        observed: [V, P] the view sees the point, and at least one other view does.

    Returns:
        [V] true where a view observes at least ``MIN_SHARED_POINTS``.

    >>> find_linked_views(np.array([[True] * 12, [True] * 9 + [False] * 3])).tolist()
    [True, False]
    """
    return observed.sum(1) >= MIN_SHARED_POINTS


def sample_log_colors(
    image: NDArray[np.uint8],  # [H, W, 3]
    uv: Float32,  # [M, 2]
) -> tuple[Float64, Float64]:
    """Reads colours from an image, and how much they vary within 3 × 3 pixels.

    Args:
        image: sRGB.
        uv: pixels, column and row, inside the image.

    Returns:
        Logarithm of linear colour [M, 3], mean over 3 × 3 pixels, and their standard deviation [M], mean over channels.
        Both are NaN where one of the pixels is clipped or dark.
    """
    height, width = image.shape[:2]
    # At the border the nearest full 3 × 3 neighbourhood stands in.
    column = uv[:, 0].astype(np.int64).clip(1, width - 2)
    row = uv[:, 1].astype(np.int64).clip(1, height - 2)
    offsets = (-1, 0, 1)
    neighbours = np.stack([image[row + y, column + x] for y in offsets for x in offsets]) / 255.0
    # One clipped or dark neighbour is enough to spoil the mean of the logarithms.
    unusable = ((neighbours < DARKEST) | (neighbours > BRIGHTEST)).any((0, 2))
    light = np.log(srgb_to_linear_above_toe(neighbours.clip(DARKEST, 1)))
    log_color = light.mean(0)
    texture = light.std(0).mean(1)
    log_color[unusable] = np.nan
    texture[unusable] = np.nan
    return log_color, texture


def srgb_to_linear_above_toe(srgb: Float64) -> Float64:
    """Converts sRGB in [0, 1] to linear light by the curve's upper branch, which holds above 0.04.

    Args:
        srgb: any shape.

    Returns:
        The same shape, linear.

    >>> srgb_to_linear_above_toe(np.array([1.0, 0.5])).round(3).tolist()
    [1.0, 0.214]
    """
    return np.asarray(((srgb + 0.055) / 1.055) ** 2.4)


def _mean_over_views(values: Float64, weight: Float64) -> Float64:
    """Weighted mean of [..., V, P] over views, [..., 1, P]; 0 where nothing counts."""
    return np.asarray((weight * values).sum(-2, keepdims=True) / np.maximum(weight.sum(0), _SMALLEST))
