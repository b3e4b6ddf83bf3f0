"""Image formats of the wire."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flows.simulators.alpasim import sensorsim_pb2
from flows.simulators.encoded_images import JPEG_QUALITY, encode_image
from genre_tasks.errors import ConfigError, InputError


def check_format(image_format: int, quality: float) -> None:
    """Checks that images can be encoded so, before one is rendered.

    Args:
        image_format: a value of the wire's ``ImageFormat``.
        quality: of JPEG, up to 100; 0: not stated.

    Raises:
        InputError: the format is missing, or the quality is out of range.
        ConfigError: the format is one that GenRe does not encode.
    """
    if image_format == sensorsim_pb2.UNDEFINED:
        raise InputError("the request has no image format", remedy="Send PNG or JPEG.")
    if image_format not in (sensorsim_pb2.PNG, sensorsim_pb2.JPEG):
        raise ConfigError(f"the image format {image_format} is not encoded", remedy="Send PNG or JPEG.")
    # Compared this way round, so that NaN fails too.
    if not 0 <= quality <= 100:
        raise InputError(f"the image quality {quality:g} is out of range", remedy="Send 1 to 100.")


def encode_pixels(pixels: NDArray[np.uint8], image_format: int, quality: float) -> bytes:
    """Encodes an image as a request asks for it.

    Args:
        pixels: [H, W, 3] sRGB.
        image_format: a value that :func:`check_format` accepts.
        quality: of JPEG, up to 100; 0: ``JPEG_QUALITY``.

    Returns:
        The bytes of a PNG or JPEG file.

    >>> encode_pixels(np.zeros((2, 3, 3), np.uint8), sensorsim_pb2.JPEG, 0.0)[:3].hex()
    'ffd8ff'
    """
    if image_format == sensorsim_pb2.PNG:
        return encode_image(pixels, "png")
    return encode_image(pixels, "jpeg", max(1, round(quality)) if quality else JPEG_QUALITY)
