"""PSNR and SSIM of one image against its truth, by scikit-image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.checks import check_finite
from genre_tasks.logs.types import Float32, Float64

PSNR_CAP_DB = 100.0
"""PSNR of identical images, and the most that any pair gets: without it a mean over images would be infinite."""

_GAUSSIAN_WINDOW_PX = 11


def psnr(
    image: Float32 | Float64,  # [H, W, 3] sRGB in [0, 1]
    truth: Float32 | Float64,  # [H, W, 3]
    mask: NDArray[np.bool_] | None = None,  # [H, W]
) -> float:
    """Computes the peak signal-to-noise ratio ``−10 log10 MSE`` over all pixels and channels.

    Args:
        image: the image to judge.
        truth: what it should show.
        mask: pixels that count; ``None``: all.

    Returns:
        dB, at most 100.

    Raises:
        ValueError: shapes differ, or the mask is empty.
        NonFiniteError: a value is NaN or infinite.

    >>> truth = np.full((8, 8, 3), 0.5, np.float32)
    >>> round(psnr(truth + np.float32(0.1), truth), 3)
    20.0
    """
    # Imported here: scikit-image is slow to load, and most commands compute no metric.
    from skimage.metrics import peak_signal_noise_ratio

    image64, truth64 = widen_pair(image, truth, mask)
    if mask is not None:
        image64 = image64[mask]
        truth64 = truth64[mask]
    # The noise of equal images is 0, and its logarithm infinite.
    if np.array_equal(image64, truth64):
        return PSNR_CAP_DB
    return min(PSNR_CAP_DB, float(peak_signal_noise_ratio(truth64, image64, data_range=1.0)))


def ssim(
    image: Float32,  # [H, W, 3] sRGB in [0, 1]
    truth: Float32,  # [H, W, 3]
    mask: NDArray[np.bool_] | None = None,  # [H, W]
) -> float:
    """Computes the mean structural similarity over pixels and channels (Wang et al. 2004).

    The window is a Gaussian of σ = 1.5 over 11 pixels. Images narrower than that get the largest uniform window that
    fits. Computed in float64; two equal constant images score 1. Pixels at the border whose window would reach beyond
    the image, 5 for the Gaussian, do not count, as in scikit-image; with a mask that has no other pixels they do.

    Args:
        image: the image to judge.
        truth: what it should show.
        mask: pixels that count; ``None``: all. Their windows may reach outside of it.

    Returns:
        A number in [−1, 1].

    Raises:
        ValueError: shapes differ, or the mask is empty.
        NonFiniteError: a value is NaN or infinite.

    >>> image = np.full((16, 16, 3), 0.5, np.float32)
    >>> round(ssim(image, image), 6)
    1.0
    """
    from skimage.metrics import structural_similarity

    image64, truth64 = widen_pair(image, truth, mask)
    # As published: covariances without Bessel's correction.
    options: dict[str, Any] = {"data_range": 1.0, "channel_axis": 2, "use_sample_covariance": False}
    smallest_side = min(image64.shape[:2])
    if smallest_side >= _GAUSSIAN_WINDOW_PX:
        options |= {"gaussian_weights": True, "sigma": 1.5}
    else:
        # The window's width must be odd.
        options["win_size"] = smallest_side - 1 | 1
    if mask is None:
        return float(structural_similarity(image64, truth64, **options))
    mean, similarity = structural_similarity(image64, truth64, full=True, **options)
    border_px = (options.get("win_size", _GAUSSIAN_WINDOW_PX) - 1) // 2
    inside = np.zeros_like(mask)
    inside[border_px : mask.shape[0] - border_px, border_px : mask.shape[1] - border_px] = True
    # A mask that leaves out nothing has the very value of no mask.
    if mask[inside].all():
        return float(mean)
    counted = mask & inside
    return float(similarity[counted if counted.any() else mask].mean())


def widen_pair(
    image: Float32 | Float64,  # [H, W, 3]
    truth: Float32 | Float64,  # [H, W, 3]
    mask: NDArray[np.bool_] | None,  # [H, W]
) -> tuple[Float64, Float64]:
    """Checks that two images can be compared, and takes them to float64.

    Args:
        image: the image to judge.
        truth: what it should show.
        mask: pixels that count; ``None``: all.

    Returns:
        Image and truth.

    Raises:
        ValueError: shapes differ, or the mask is empty.
        NonFiniteError: a value is NaN or infinite.
    """
    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"expected two images of shape [H, W, 3], got {image.shape} and {truth.shape}")
    if mask is not None and mask.shape != image.shape[:2]:
        raise ValueError(f"expected a mask of shape {image.shape[:2]}, got {mask.shape}")
    if mask is not None and not mask.any():
        raise ValueError("the mask is empty: there is nothing to compare")
    check_finite(image, "image", "evaluate")
    check_finite(truth, "truth", "evaluate")
    # Sums over a million pixels lose in float32 what near images differ in.
    return image.astype(np.float64), truth.astype(np.float64)
