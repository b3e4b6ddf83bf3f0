"""Encoded images (JPEG, PNG) to pixels at the working resolution."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageFile
from torch import Tensor

from genre_tasks.errors import InputError

# Truncated files must raise; another package may have set this flag of the process.
ImageFile.LOAD_TRUNCATED_IMAGES = False

# What PIL raises for files that are truncated, corrupt, of an unknown format or absurdly large.
_DECODE_ERRORS = (OSError, SyntaxError, ValueError, EOFError, zlib.error, struct.error, Image.DecompressionBombError)

_REMEDY = "Fetch the file again, or remove it."


def decode_pixels(data: bytes, width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Decodes an image and averages it down to the working resolution. Deterministic.

    Args:
        data: the encoded file.
        width_px: of the result; each axis is resampled on its own.
        height_px: of the result.

    Returns:
        [H, W, 3] uint8 sRGB; means over areas, or bilinear where the image is enlarged.

    Raises:
        InputError: the file is truncated or corrupt.

    >>> file = io.BytesIO()
    >>> Image.new("RGB", (8, 4), (255, 0, 0)).save(file, "PNG")
    >>> decode_pixels(file.getvalue(), 2, 1).tolist()
    [[[255, 0, 0], [255, 0, 0]]]
    """
    try:
        with Image.open(io.BytesIO(data)) as image:
            # JPEG decodes faster at a half, a quarter or an eighth of its size, an average over blocks of the DCT. At
            # twice the size of the result at least two of its pixels are left per pixel, so the average stays one.
            image.draft("RGB", (2 * width_px, 2 * height_px))
            rgb = image.convert("RGB")
    except _DECODE_ERRORS as error:
        raise InputError(f"cannot decode the image: {error}", remedy=_REMEDY) from error
    # A box filter averages over areas, which only makes sense where there is more than a pixel in each.
    reduces = rgb.width >= width_px and rgb.height >= height_px
    if rgb.size != (width_px, height_px):
        rgb = rgb.resize((width_px, height_px), Image.Resampling.BOX if reduces else Image.Resampling.BILINEAR)
    return np.asarray(rgb)


def decode_image(data: bytes, width_px: int, height_px: int) -> Tensor:
    """Decodes an image as the losses and networks take it.

    Args:
        data: the encoded file.
        width_px: of the result.
        height_px: of the result.

    Returns:
        [H, W, 3] float32 sRGB in [0, 1], resampled as by :func:`decode_pixels`.

    Raises:
        InputError: the file is truncated or corrupt.
    """
    return torch.from_numpy(decode_pixels(data, width_px, height_px).astype(np.float32) / np.float32(255))


def read_image_size(data: bytes) -> tuple[int, int]:
    """Reads an image's size from its header, without decoding the pixels.

    Args:
        data: the encoded file.

    Returns:
        Width and height in pixels.

    Raises:
        InputError: the format is unknown.
    """
    try:
        with Image.open(io.BytesIO(data)) as image:
            return image.size
    except _DECODE_ERRORS as error:
        raise InputError(f"cannot decode the image: {error}", remedy=_REMEDY) from error


def is_decodable(data: bytes) -> bool:
    """Tells whether every pixel of an encoded image can be decoded.

    >>> is_decodable(b"no image")
    False
    """
    try:
        # A small result lets JPEG skip most of its work, but all of the file is still read.
        decode_pixels(data, 16, 16)
    except InputError:
        return False
    return True
