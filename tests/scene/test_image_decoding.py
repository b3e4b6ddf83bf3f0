"""Decoding and area averaging of encoded images."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from genre_tasks.errors import InputError
from genre_tasks.scene.image_decoding import decode_image, decode_pixels, inspect_image, read_image_size


def _encoded(pixels: np.ndarray, form: str, **options: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, form, **options)
    return stream.getvalue()


def _noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_png_is_area_averaged_on_each_axis() -> None:
    pixels = _noise(24, 60)
    expected = pixels.reshape(6, 4, 10, 6, 3).mean((1, 3))
    out = decode_pixels(_encoded(pixels, "PNG"), 10, 6)
    # Two passes, each rounded to 8 bits.
    assert np.abs(out - expected).max() <= 1.0


def _area_means(pixels: np.ndarray, size: int) -> np.ndarray:
    """Exact means along the first axis, by differences of interpolated sums."""
    sums = np.concatenate([np.zeros((1, *pixels.shape[1:])), pixels.astype(np.float64).cumsum(0)])
    borders = np.arange(size + 1) * len(pixels) / size
    index = np.floor(borders).astype(int).clip(0, len(pixels) - 1)
    at = sums[index] + (borders - index)[:, None, None] * (sums[index + 1] - sums[index])
    return np.diff(at, axis=0) * size / len(pixels)


@pytest.mark.parametrize(("native", "working"), [((60, 90), (40, 60)), ((75, 248), (19, 64)), ((45, 80), (44, 80))])
def test_areas_may_end_within_pixels(native: tuple[int, int], working: tuple[int, int]) -> None:
    pixels = _noise(*native)
    expected = _area_means(_area_means(pixels, working[0]).swapaxes(0, 1), working[1]).swapaxes(0, 1)
    out = decode_pixels(_encoded(pixels, "PNG"), working[1], working[0])
    # Rounded once.
    assert np.abs(out - expected).max() <= 0.5 + 1e-3


@pytest.mark.parametrize(("height", "width"), [(222, 480), (223, 481), (250, 484)])
def test_a_jpeg_of_any_size_is_not_stretched(height: int, width: int) -> None:
    ramp = np.broadcast_to(np.linspace(10, 245, height)[:, None], (height, width))
    pixels = np.stack([ramp] * 3, -1).round().astype(np.uint8)
    data = _encoded(pixels, "JPEG", quality=98)
    full = np.asarray(Image.open(io.BytesIO(data)))
    # Four rows of the image are one of the result, at most: a stretched one would be off by a level or more.
    expected = _area_means(_area_means(full, height // 20).swapaxes(0, 1), width // 20).swapaxes(0, 1)
    assert np.abs(decode_pixels(data, width // 20, height // 20) - expected).max() <= 1.6


def test_jpeg_decoded_small_is_near_the_full_average() -> None:
    ramp = np.add.outer(np.arange(512), np.arange(1024)) / 6.1
    pixels = np.stack([ramp, 255 - ramp, 128 + 0 * ramp], -1).clip(0, 255).astype(np.uint8)
    data = _encoded(pixels, "JPEG", quality=95)
    full = np.asarray(Image.open(io.BytesIO(data))).reshape(64, 8, 128, 8, 3).mean((1, 3))
    assert np.abs(decode_pixels(data, 128, 64) - full).max() <= 2.0


def test_range_shape_and_dtype() -> None:
    image = decode_image(_encoded(_noise(9, 16), "PNG"), 16, 9)
    assert image.shape == (9, 16, 3) and image.dtype.is_floating_point
    assert float(image.min()) >= 0 and float(image.max()) <= 1
    assert np.array_equal(np.round(image.numpy() * 255).astype(np.uint8), _noise(9, 16))


def test_grey_and_transparent_images_become_rgb() -> None:
    assert decode_pixels(_encoded(_noise(8, 8)[..., 0], "PNG"), 8, 8).shape == (8, 8, 3)
    assert decode_pixels(_encoded(np.dstack([_noise(8, 8), _noise(8, 8)[..., :1]]), "PNG"), 8, 8).shape == (8, 8, 3)


@pytest.mark.parametrize("form", ["PNG", "JPEG"])
def test_broken_files_raise(form: str) -> None:
    data = _encoded(_noise(64, 64), form)
    assert read_image_size(data) == (64, 64)
    facts = inspect_image(data)
    assert (facts.width_px, facts.height_px, facts.findings) == (64, 64, ())
    for broken in (data[: len(data) // 2], data[:10], b"", b"nothing of an image"):
        with pytest.raises(InputError, match="cannot decode"):
            inspect_image(broken)
        with pytest.raises(InputError, match="cannot decode"):
            decode_image(broken, 16, 16)


def test_a_flipped_png_byte_raises() -> None:
    data = bytearray(_encoded(_noise(64, 64), "PNG"))
    data[len(data) // 2] ^= 0xFF
    with pytest.raises(InputError, match="cannot decode"):
        inspect_image(bytes(data))
