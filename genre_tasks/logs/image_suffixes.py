"""Suffixes of encoded images, by their first bytes."""

from __future__ import annotations

import re
from typing import Any

from genre_tasks.errors import InputError

_SUFFIX_OF_SIGNATURE = {
    rb"\xff\xd8\xff": ".jpg",
    rb"\x89PNG\r\n\x1a\n": ".png",
    rb"RIFF....WEBP": ".webp",
    rb"II\*\0|MM\0\*": ".tif",
    rb"BM": ".bmp",
}


def find_image_suffix(image: bytes, **where: Any) -> str:
    """Finds the suffix of an image's file.

    Args:
        image: encoded.
        where: ``log``, ``camera``, ``frame`` of the error, should there be one.

    Returns:
        ``.jpg``, ``.png``, ``.webp``, ``.tif`` or ``.bmp``.

    Raises:
        InputError: the image is of another format.

    >>> find_image_suffix(b"BM...")
    '.bmp'
    """
    for signature, suffix in _SUFFIX_OF_SIGNATURE.items():
        if re.match(signature, image, re.DOTALL):
            return suffix
    remedy = "Encode the image as JPEG or PNG, or remove it: a missing image is survived."
    raise InputError("the image is neither JPEG, PNG, WebP, TIFF nor BMP", remedy=remedy, **where)
