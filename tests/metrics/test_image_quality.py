"""PSNR and SSIM: values, masks, hard cases."""

from __future__ import annotations

import numpy as np
import pytest

from genre_tasks.errors import NonFiniteError
from genre_tasks.metrics.image_quality import PSNR_CAP_DB, psnr, ssim


def picture(height: int = 32, width: int = 40, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return np.kron(generator.random((height // 4 + 1, width // 4 + 1, 3)), np.ones((4, 4, 1)))[:height, :width].astype(
        np.float32
    )


@pytest.mark.parametrize(("offset", "expected"), [(0.1, 20.0), (0.01, 40.0), (0.5, 6.0206)])
def test_psnr_of_a_constant_offset(offset: float, expected: float) -> None:
    image = np.full((8, 9, 3), 0.25, np.float32)
    assert psnr(image + np.float32(offset), image) == pytest.approx(expected, abs=1e-4)


def test_identical_images() -> None:
    image = picture()
    assert psnr(image, image.copy()) == PSNR_CAP_DB == 100.0
    assert ssim(image, image.copy()) == pytest.approx(1.0, abs=1e-12)
    nearly = np.full((4, 4, 3), 0.5, np.float32)
    assert psnr(nearly + np.float32(1e-7), nearly) == PSNR_CAP_DB


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_constant_images(value: float) -> None:
    image = np.full((24, 24, 3), value, np.float32)
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-12)
    other = np.full((24, 24, 3), 1.0 - value if value != 0.5 else 0.2, np.float32)
    assert 0.0 <= ssim(other, image) < 0.99


def test_ssim_is_the_published_one() -> None:
    """Against a direct evaluation of the formula at one pixel whose window lies inside."""
    a, b = picture(11, 11, 1)[..., :1], picture(11, 11, 2)[..., :1]
    axis = np.arange(-5, 6)
    window = np.exp(-(axis**2) / (2 * 1.5**2))
    window = np.outer(window, window)[..., None] / window.sum() ** 2
    x, y = a.astype(float), b.astype(float)
    mx, my = (window * x).sum(), (window * y).sum()
    vx, vy, vxy = (window * x * x).sum() - mx**2, (window * y * y).sum() - my**2, (window * x * y).sum() - mx * my
    expected = (2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    assert ssim(a.repeat(3, 2), b.repeat(3, 2)) == pytest.approx(expected, abs=1e-6)


def test_mask_leaves_out_what_it_should() -> None:
    truth = picture()
    image = truth.copy()
    image[:16] = 1 - image[:16]
    mask = np.zeros(truth.shape[:2], bool)
    mask[24:] = True
    assert psnr(image, truth, mask) == 100.0
    assert ssim(image, truth, mask) == pytest.approx(1.0, abs=1e-9)
    assert psnr(image, truth, ~mask) < 20
    assert psnr(image, truth, np.ones_like(mask)) == pytest.approx(psnr(image, truth))


@pytest.mark.parametrize("size", [(1, 1), (2, 5), (7, 11), (10, 40), (11, 11), (17, 33)])
def test_small_images(size: tuple[int, int]) -> None:
    image = picture(*size)
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-12)
    assert -1 <= ssim(1 - image, image) < 1


def test_faults() -> None:
    image = picture()
    with pytest.raises(ValueError, match="expected two images"):
        psnr(image, image[:-1])
    with pytest.raises(ValueError, match="mask is empty"):
        ssim(image, image, np.zeros(image.shape[:2], bool))
    with pytest.raises(ValueError, match="expected a mask of shape"):
        psnr(image, image, np.ones((2, 2), bool))
    broken = image.copy()
    broken[3, 4, 1] = np.nan
    with pytest.raises(NonFiniteError) as caught:
        psnr(broken, image)
    assert (caught.value.tensor, caught.value.count, caught.value.first_index) == ("image", 1, (3, 4, 1))


@pytest.mark.parametrize("size", [(32, 40), (9, 12)])
def test_ssim_leaves_out_the_border_with_a_mask_too(size: tuple[int, int]) -> None:
    truth = picture(*size)
    image = truth.copy()
    image[:2] = 1 - image[:2]
    everything = np.ones(size, bool)
    assert ssim(image, truth, everything) == ssim(image, truth)
    nearly = everything.copy()
    nearly[-1, -1] = False
    assert ssim(image, truth, nearly) == ssim(image, truth)
    # A mask that has nothing but the border still gets a value.
    border = np.zeros(size, bool)
    border[0] = True
    assert ssim(image, truth, border) < 0.5
