"""PSNR and SSIM of one image against its truth, by scikit-image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import NonFiniteError
from genre_tasks.logs.types import Float32

PSNR_CAP_DB = 100.0
"""PSNR of identical images, and the most that any pair gets: without it a mean over images would be infinite."""

_GAUSSIAN_WINDOW = 11


def psnr(
    image: Float32,  # [H, W, 3] sRGB in [0, 1]
    truth: Float32,  # [H, W, 3]
    mask: NDArray[np.bool_] | None = None,  # [H, W]
) -> float:
    """Peak signal-to-noise ratio, dB: ``−10 log10 MSE`` over all channels (of the masked pixels), at most 100.

    Raises:
        ValueError: shapes differ, or the mask is empty.
        NonFiniteError: a value is NaN or infinite.
    """
    from skimage.metrics import peak_signal_noise_ratio

    left, right = _checked(image, truth, mask)
    if mask is not None:
        left, right = left[mask], right[mask]
    if np.array_equal(left, right):
        return PSNR_CAP_DB
    return min(PSNR_CAP_DB, float(peak_signal_noise_ratio(right, left, data_range=1.0)))


def ssim(
    image: Float32,  # [H, W, 3] sRGB in [0, 1]
    truth: Float32,  # [H, W, 3]
    mask: NDArray[np.bool_] | None = None,  # [H, W]
) -> float:
    """Structural similarity (Wang et al. 2004: Gaussian window of σ = 1.5, 11 px), mean over pixels and channels.

    Computed in float64; two equal constant images score 1. Images narrower than the window get the largest uniform
    window that fits. With a mask, the mean is over the masked pixels of the map (their windows may reach outside).

    Raises:
        ValueError: shapes differ, or the mask is empty. NonFiniteError: a value is NaN or infinite.
    """
    from skimage.metrics import structural_similarity

    left, right = _checked(image, truth, mask)
    small = min(left.shape[:2])
    window = {"gaussian_weights": True, "sigma": 1.5} if small >= _GAUSSIAN_WINDOW else {"win_size": small - 1 | 1}
    common = {"data_range": 1.0, "channel_axis": 2, "use_sample_covariance": False, **window}
    if mask is None:
        return float(structural_similarity(left, right, **common))
    return float(structural_similarity(left, right, full=True, **common)[1][mask].mean())


def _checked(
    image: Float32, truth: Float32, mask: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if image.shape != truth.shape or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"expected two images of shape [H, W, 3], got {image.shape} and {truth.shape}")
    if mask is not None and mask.shape != image.shape[:2]:
        raise ValueError(f"expected a mask of shape {image.shape[:2]}, got {mask.shape}")
    if mask is not None and not mask.any():
        raise ValueError("the mask is empty: there is nothing to compare")
    for name, array in (("image", image), ("truth", truth)):
        bad = np.argwhere(~np.isfinite(array))
        if len(bad):
            raise NonFiniteError("evaluate", name, len(bad), tuple(int(i) for i in bad[0]))
    return image.astype(np.float64), truth.astype(np.float64)
