"""Encoded images to 8-bit sRGB pixels at the working resolution, by one set of rules.

========================================== =========================================================================
what the file holds                        what is done with it
========================================== =========================================================================
RGB or grey of 8 bits                      taken as it is; grey becomes three equal channels
1 bit                                      0 and 255; warning ``one_bit_image``, since it is rather a mask
grey of 2 or 4 bits                        scaled to 0–255, as the formats say
palette                                    its colours
grey of 9 to 16 bits (PNG, TIFF, PGM, JP2) v·255/m, rounded; note ``reduced_depth``. m is of the stated depth (TIFF:
                                           BitsPerSample; PNG: sBIT, where the samples stand in the lower bits; PGM:
                                           its maximum), else 65535. Where no sample of 16 bits needs more than 14:
                                           warning ``narrow_range_16_bit``
RGB of 16 bits (PNG, TIFF)                 the upper 8 bits, as Pillow decodes it; the same findings
zero is white (TIFF)                       inverted
floating point, 32 bits, signed            refused: no range is known
alpha, transparent palette entry or colour dropped: colours are taken as stored. If any pixel is not opaque: warning
                                           ``transparent_image``. Premultiplied colours are divided by alpha first
ICC profile                                converted to sRGB, relative colorimetric; note ``converted_colors``. A
                                           profile within 2 of 255 levels of sRGB changes nothing. One that cannot be
                                           used: warning ``unconverted_colors``
gAMA of a PNG without profile              converted, unless within 5 % of 1/2.2; note ``converted_colors``
cHRM of a PNG without profile              not converted: warning ``unconverted_colors``
cICP of a PNG, nclx of an AVIF             sRGB and BT.709 are taken as they are; HDR and wide gamut are refused
CMYK, YCCK (also Adobe's inverted),        converted, by the profile if there is one; note ``converted_colors``
YCbCr, L*a*b*
EXIF orientation other than 1              refused: intrinsics may describe the stored or the turned pixels
several pictures (GIF, APNG, WebP, TIFF)   the first one; warning ``several_pictures``, a note where the format says
                                           that the first one is the main one (MPO)
one colour all over                        warning ``blank_image``; left out of a run
truncated, corrupt, more than 100 million  refused
pixels, no image at all
========================================== =========================================================================

What no file says cannot be known: a Bayer mosaic that was stored as grey, or linear samples without a gamma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from genre_tasks.logs.findings import Finding
from genre_tasks.scene.area_means import average_areas
from genre_tasks.scene.image_conversion import convert_to_srgb
from genre_tasks.scene.image_header import DECODE_ERRORS, ImageHeader, describe_decode_error, open_image

# Means over a grid of at most so many areas tell a blank picture: noise averages out, any object does not.
_BLANK_GRID = (64, 36)
_BLANK_LEVELS = 2
# A PNG of one colour is compressed to less than a hundredth; others have their checksums verified instead.
_BLANK_PNG_PIXELS_PER_BYTE = 30
# Smaller images take no time to decode.
_SMALL_PIXELS = 65_536


@dataclass(frozen=True)
class ImageFacts:
    """What is to be known of an image that can be decoded.

    Attributes:
        width_px: as stored.
        height_px: as stored.
        is_blank: all of it has one colour.
        findings: what decoding it loses or assumes.
    """

    width_px: int
    height_px: int
    is_blank: bool
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class DecodedImage:
    """An image at the working resolution.

    Attributes:
        data: the encoded file.
        pixels: [H, W, 3] uint8 sRGB.
        facts: what is to be known of it.
    """

    data: bytes
    pixels: NDArray[np.uint8]
    facts: ImageFacts


def decode_pixels(data: bytes, width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Decodes an image and averages it down to the working resolution. Deterministic.

    Args:
        data: the encoded file.
        width_px: of the result; each axis is resampled on its own.
        height_px: of the result.

    Returns:
        [H, W, 3] uint8 sRGB; means over areas, or bilinear where the image is enlarged.

    Raises:
        InputError: the file is truncated, corrupt, or refused by the rules above.

    >>> import io
    >>> file = io.BytesIO()
    >>> Image.new("RGB", (8, 4), (255, 0, 0)).save(file, "PNG")
    >>> decode_pixels(file.getvalue(), 2, 1).tolist()
    [[[255, 0, 0], [255, 0, 0]]]
    """
    return np.asarray(_decode_resized(data, width_px, height_px)[0])


def decode_with_facts(data: bytes, width_px: int, height_px: int) -> DecodedImage:
    """Decodes an image and reports what is to be known of it.

    Args:
        data: the encoded file.
        width_px: of the result.
        height_px: of the result.

    Returns:
        Pixels as by :func:`decode_pixels`, and the facts.

    Raises:
        InputError: the file is truncated, corrupt, or refused by the rules above.
    """
    rgb, header, findings = _decode_resized(data, width_px, height_px)
    return DecodedImage(data, np.asarray(rgb), _facts(header, findings, _is_blank(rgb)))


def decode_image(data: bytes, width_px: int, height_px: int) -> Tensor:
    """Decodes an image as the losses and networks take it.

    Args:
        data: the encoded file.
        width_px: of the result.
        height_px: of the result.

    Returns:
        [H, W, 3] float32 sRGB in [0, 1], resampled as by :func:`decode_pixels`.

    Raises:
        InputError: the file is truncated, corrupt, or refused by the rules above.
    """
    return torch.from_numpy(decode_pixels(data, width_px, height_px).astype(np.float32) / np.float32(255))


def inspect_image(data: bytes) -> ImageFacts:
    """Reports what is to be known of an image, in less time than decoding takes.

    All of the file is read: a JPEG is decoded at an eighth of its size, an ordinary PNG has its checksums verified.

    Args:
        data: the encoded file.

    Returns:
        The facts, the same as those of :func:`decode_with_facts`.

    Raises:
        InputError: the file is truncated, corrupt, or refused by the rules above.

    >>> inspect_image(b"no image")
    Traceback (most recent call last):
    genre_tasks.errors.InputError: cannot decode the image: its format is unknown, or ...
    """
    try:
        image, header = open_image(data)
        if _is_verifiable(image, header, len(data)) and _verifies(image):
            return _facts(header, (), is_blank=False)
    except DECODE_ERRORS as error:
        raise describe_decode_error(error) from error
    image, header = _load(data, (max(image.width // 8, _BLANK_GRID[0]), max(image.height // 8, _BLANK_GRID[1])))
    rgb, findings = _convert(image, header)
    return _facts(header, findings, _is_blank(rgb))


def read_image_size(data: bytes) -> tuple[int, int]:
    """Reads an image's size from its header, without decoding the pixels.

    Args:
        data: the encoded file.

    Returns:
        Width and height in pixels, as stored.

    Raises:
        InputError: the format is unknown, or refused by the rules above.
    """
    try:
        image, header = open_image(data)
        image.close()
    except DECODE_ERRORS as error:
        raise describe_decode_error(error) from error
    return header.width_px, header.height_px


def _load(data: bytes, draft_size: tuple[int, int], exact: bool = False) -> tuple[Image.Image, ImageHeader]:
    """Opens and decodes an image; a JPEG at a half, a quarter or an eighth, where that is not below the given size.

    Where ``exact``, only at fractions that divide both sides: others are rounded up, so that the image would be
    stretched.
    """
    try:
        image, header = open_image(data)
        image.draft("RGB", _exact_draft_size(image.size, draft_size) if exact else draft_size)
        image.load()
    except DECODE_ERRORS as error:
        raise describe_decode_error(error) from error
    return image, header


def _exact_draft_size(size: tuple[int, int], smallest: tuple[int, int]) -> tuple[int, int]:
    """The smallest size, not below another one, of which an image's size is 1, 2, 4 or 8 times as much."""
    for factor in (8, 4, 2):
        fits = size[0] >= factor * smallest[0] and size[1] >= factor * smallest[1]
        if fits and size[0] % factor == 0 and size[1] % factor == 0:
            return size[0] // factor, size[1] // factor
    return size


def _convert(image: Image.Image, header: ImageHeader) -> tuple[Image.Image, tuple[Finding, ...]]:
    try:
        return convert_to_srgb(image, header)
    # Pixels may name colours that a palette does not have, which shows only here.
    except DECODE_ERRORS as error:
        raise describe_decode_error(error) from error


def _decode_resized(data: bytes, width_px: int, height_px: int) -> tuple[Image.Image, ImageHeader, tuple[Finding, ...]]:
    # JPEG decodes faster at a fraction of its size, an average over blocks of the DCT. At twice the size of the result
    # at least two of its pixels are left per pixel, so the average stays one.
    image, header = _load(data, (2 * width_px, 2 * height_px), exact=True)
    rgb, findings = _convert(image, header)
    if rgb.size != (width_px, height_px):
        rgb = _resize(rgb, width_px, height_px)
    return rgb, header, findings


def _resize(rgb: Image.Image, width_px: int, height_px: int) -> Image.Image:
    # Means over areas only make sense where there is more than a pixel in each.
    if rgb.width < width_px or rgb.height < height_px:
        return rgb.resize((width_px, height_px), Image.Resampling.BILINEAR)
    # Pillow's box filter is exact where areas end between pixels, and faster.
    if rgb.width % width_px == 0 and rgb.height % height_px == 0:
        return rgb.resize((width_px, height_px), Image.Resampling.BOX)
    return Image.fromarray(average_areas(np.asarray(rgb), width_px, height_px))


def _is_verifiable(image: Image.Image, header: ImageHeader, file_bytes: int) -> bool:
    """Whether an image is an ordinary PNG: nothing of it is converted, and its checksums tell a damaged one."""
    ordinary = image.format == "PNG" and image.mode in ("RGB", "L") and header.bits <= 8 and header.pictures == 1
    if not ordinary or {"transparency", "icc_profile", "gamma", "chromaticity"} & set(image.info):
        return False
    return _BLANK_PNG_PIXELS_PER_BYTE * file_bytes > image.width * image.height > _SMALL_PIXELS


def _verifies(image: Image.Image) -> bool:
    """Whether the checksums are right; where they are not, decoding says what is wrong, in the words of a run."""
    try:
        image.verify()
    except DECODE_ERRORS:
        return False
    return True


def _facts(header: ImageHeader, findings: tuple[Finding, ...], is_blank: bool) -> ImageFacts:
    return ImageFacts(header.width_px, header.height_px, is_blank, findings)


def _is_blank(rgb: Image.Image) -> bool:
    """Whether all areas of an image have the same mean, to within a rounding."""
    grid = (min(rgb.width, _BLANK_GRID[0]), min(rgb.height, _BLANK_GRID[1]))
    means = rgb if rgb.size == grid else rgb.resize(grid, Image.Resampling.BOX)
    return bool((np.ptp(np.asarray(means), axis=(0, 1)) <= _BLANK_LEVELS).all())
