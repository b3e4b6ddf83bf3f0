"""Encoded images (JPEG, PNG) to tensors at the working resolution."""

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

_BROKEN = (OSError, SyntaxError, ValueError, EOFError, zlib.error, struct.error, Image.DecompressionBombError)
"""What PIL raises for files that are truncated, corrupt, of an unknown format or absurdly large."""


def decode_pixels(data: bytes, width_px: int, height_px: int) -> NDArray[np.uint8]:
    """An encoded image as [H, W, 3] uint8 sRGB, area-averaged to ``width_px × height_px`` (each axis on its own).

    JPEG may be decoded at a half, a quarter or an eighth of its size (an average over blocks in the DCT), but only
    where at least two of its pixels are left per pixel of the result. Enlarging is bilinear. Deterministic.
    Raises ``InputError`` for a truncated or corrupt file.
    """
    try:
        with Image.open(io.BytesIO(data)) as image:
            image.draft("RGB", (2 * width_px, 2 * height_px))
            rgb = image.convert("RGB")
    except _BROKEN as error:
        raise InputError(f"cannot decode the image: {error}", remedy="Fetch the file again, or remove it.") from error
    reduces = rgb.width >= width_px and rgb.height >= height_px
    if rgb.size != (width_px, height_px):
        rgb = rgb.resize((width_px, height_px), Image.Resampling.BOX if reduces else Image.Resampling.BILINEAR)
    return np.asarray(rgb)


def decode_image(data: bytes, width_px: int, height_px: int) -> Tensor:
    """As :func:`decode_pixels`, as a tensor [H, W, 3] float32 in [0, 1]."""
    return torch.from_numpy(decode_pixels(data, width_px, height_px).astype(np.float32) / np.float32(255))


def encoded_size(data: bytes) -> tuple[int, int]:
    """(width, height) of an encoded image from its header. Raises ``InputError`` for an unknown format."""
    try:
        with Image.open(io.BytesIO(data)) as image:
            return image.size
    except _BROKEN as error:
        raise InputError(f"cannot decode the image: {error}", remedy="Fetch the file again, or remove it.") from error


def encoded_ok(data: bytes) -> bool:
    """Whether every pixel can be decoded."""
    try:
        decode_pixels(data, 16, 16)
    except InputError:
        return False
    return True
