"""PSNR after a fit of the colours: the published procedure, what it takes off, and images that leave nothing to fit."""

from __future__ import annotations

import numpy as np
import pytest

from genre_tasks.errors import NonFiniteError
from genre_tasks.metrics.color_fit import cc_psnr, fit_colors
from genre_tasks.metrics.image_quality import PSNR_CAP_DB, psnr


def street(seed: int = 0, height: int = 36, width: int = 48) -> np.ndarray:
    """Blocks of nearly grey colours over all of [0, 1], some of them cut off at its ends."""
    generator = np.random.default_rng(seed)
    grey = np.kron(generator.uniform(-0.1, 1.1, (height // 4, width // 4, 1)), np.ones((4, 4, 1)))
    return np.clip(grey + 0.05 * generator.standard_normal((height, width, 3)), 0, 1).astype(np.float32)


def published_fit(image: np.ndarray, truth: np.ndarray, dtype: type) -> np.ndarray:
    """The procedure of multinerf by a general least-squares solver: what its description says, pixel by pixel."""
    low, high = 0.5 / 255, 1 - 0.5 / 255
    colors, goal = image.reshape(-1, 3).astype(dtype), truth.reshape(-1, 3).astype(dtype)
    never = (colors < low) | (colors > high) | (goal < low) | (goal > high)
    for _ in range(5):
        r, g, b = colors.T
        design = np.stack([r * r, r * g, r * b, g * g, g * b, b * b, r, g, b, np.ones_like(r)], 1)
        fitted = []
        for c in range(3):
            rows = ~never[:, c] & (colors[:, c] >= low) & (colors[:, c] <= high)
            weights = np.linalg.lstsq(design[rows], goal[rows, c], rcond=None)[0]
            fitted.append(np.clip(design @ weights, 0, 1))
        colors = np.stack(fitted, 1)
    return colors.reshape(image.shape).astype(np.float64)


@pytest.mark.parametrize("seed", range(4))
def test_the_fit_is_the_published_one(seed: int) -> None:
    truth = street(seed)
    noise = 0.03 * np.random.default_rng(100 + seed).standard_normal(truth.shape)
    image = np.clip(0.75 * truth**1.2 + 0.02 + noise, 0, 1).astype(np.float32)
    # The same solution by another way; the published code computes it in float32.
    assert np.abs(fit_colors(image, truth) - published_fit(image, truth, np.float64)).max() < 1e-7
    assert cc_psnr(image, truth) == pytest.approx(psnr(published_fit(image, truth, np.float32), truth), abs=1e-3)
    assert psnr(image, truth) + 3 < cc_psnr(image, truth) < 35


@pytest.mark.parametrize(
    "warp",
    [
        lambda x: x * np.float32([0.6, 0.7, 0.8]),
        lambda x: 0.5 * x + np.float32([0.0, 0.1, 0.2]),
        lambda x: np.stack([x[..., 1], x[..., 2], x[..., 0]], 2),
    ],
)
def test_a_copy_in_other_colours_has_no_error_left(warp) -> None:
    truth = np.clip(street(), 0.1, 0.9) * np.float32(0.9)
    image = warp(truth).astype(np.float32)
    assert psnr(image, truth) < 30
    assert cc_psnr(image, truth) > 80


def test_errors_that_are_none_of_colour_stay() -> None:
    truth = np.clip(street(), 0.2, 0.8)
    # Equal in all channels, since noise of single channels lets a fit average the others.
    noise = 0.05 * np.random.default_rng(1).standard_normal((*truth.shape[:2], 1))
    image = np.clip(truth + noise, 0, 1).astype(np.float32)
    assert psnr(image, truth) == pytest.approx(26.0, abs=0.3)
    assert psnr(image, truth) <= cc_psnr(image, truth) < psnr(image, truth) + 1
    assert cc_psnr(image[:, ::-1].copy(), truth) < 16


def test_identical_images_are_at_the_cap() -> None:
    truth = street()
    assert cc_psnr(truth, truth.copy()) == PSNR_CAP_DB


def test_pixels_outside_of_the_mask_count_nowhere() -> None:
    truth = np.clip(street(), 0.1, 0.9)
    image = (truth * 0.7).astype(np.float32)
    mask = np.ones(truth.shape[:2], bool)
    mask[20:] = False
    expected = cc_psnr(image[:20], truth[:20])
    image[20:] = np.random.default_rng(3).random(image[20:].shape)
    assert cc_psnr(image, truth, mask) == pytest.approx(expected, abs=1e-6)
    assert expected > 80 > 40 > cc_psnr(image, truth)
    assert np.array_equal(fit_colors(image, truth, mask)[20:], image[20:])


@pytest.mark.parametrize("grey", [0.3, 0.999, 0.002])
def test_a_constant_image_is_fitted_to_the_mean(grey: float) -> None:
    image = np.full((12, 16, 3), grey, np.float32)
    truth = np.clip(street(5, 12, 16), 0.1, 0.9)
    error = ((truth - truth.mean((0, 1))) ** 2).mean()
    # A saturated image tells nothing of its colours and stays as it is.
    expected = psnr(image, truth) if grey == 0.999 else -10 * np.log10(error)
    assert cc_psnr(image, truth) == pytest.approx(expected, abs=1e-4)
    assert cc_psnr(np.full_like(image, 0.3), np.full_like(image, 0.6)) > 99


def test_grey_images_have_fewer_colours_than_unknowns() -> None:
    truth = np.clip(street(), 0.1, 0.9)[..., :1].repeat(3, 2)
    assert cc_psnr(0.5 * truth, truth) > 80


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_a_saturated_truth_leaves_the_image_as_it_is(value: float) -> None:
    truth = np.full((12, 16, 3), value, np.float32)
    assert cc_psnr(truth, truth) == PSNR_CAP_DB
    half = np.full_like(truth, 0.5)
    assert cc_psnr(half, truth) == pytest.approx(psnr(half, truth)) == pytest.approx(6.0206, abs=1e-4)


def test_a_saturated_channel_alone_is_not_fitted() -> None:
    truth = np.clip(street(), 0.1, 0.9)
    truth[..., 2] = 1.0
    image = (0.8 * truth).astype(np.float32)
    fitted = fit_colors(image, truth)
    assert np.abs(fitted - truth)[..., :2].max() < 1e-4
    assert np.array_equal(fitted[..., 2], image[..., 2])


def test_one_pixel_is_fitted_exactly() -> None:
    assert cc_psnr(np.full((1, 1, 3), 0.2, np.float32), np.full((1, 1, 3), 0.7, np.float32)) > 90


def test_what_cannot_be_compared_is_refused() -> None:
    image = street()
    with pytest.raises(ValueError, match="mask is empty"):
        cc_psnr(image, image, np.zeros(image.shape[:2], bool))
    with pytest.raises(ValueError, match="two images of shape"):
        cc_psnr(image, image[:4])
    broken = image.copy()
    broken[3, 4, 1] = np.nan
    for pair in ((broken, image), (image, broken)):
        with pytest.raises(NonFiniteError):
            cc_psnr(*pair)
