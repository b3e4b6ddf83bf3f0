"""Pictures inside of the page: photos as WebP, maps as PNG with a palette."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_MAX_WIDTH_PX = 1600
"""Wider pictures are scaled down: a page shows no more."""
_QUALITY = 90


@dataclass(frozen=True)
class EmbeddedImage:
    """An image inside of the page.

    Attributes:
        url: the image as a ``data:`` URL.
        width: pixels, before it was scaled down.
        height: pixels.
    """

    url: str
    width: int
    height: int


def embed_photo(png: bytes) -> EmbeddedImage:
    """Turns a stored picture into one for the page, in whichever of WebP and PNG is smaller.

    Args:
        png: bytes of a PNG file.

    Returns:
        The image with its size.
    """
    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        width, height = image.size
        shown = image.convert("RGB")
    if width > _MAX_WIDTH_PX:
        shown = shown.resize((_MAX_WIDTH_PX, max(1, round(height * _MAX_WIDTH_PX / width))))
    sink = io.BytesIO()
    shown.save(sink, "WEBP", quality=_QUALITY, method=4)
    webp = sink.getvalue()
    # A tiny or flat picture is smaller without loss.
    if len(png) <= len(webp):
        return EmbeddedImage(_data_url("image/png", png), width, height)
    return EmbeddedImage(_data_url("image/webp", webp), width, height)


def embed_map(levels: NDArray[np.uint8], palette: NDArray[np.uint8]) -> EmbeddedImage:
    """Turns a map of few levels into an image without loss.

    Args:
        levels: [H, W] row of the palette.
        palette: [L, 3] sRGB.

    Returns:
        The image with its size.
    """
    from PIL import Image

    image = Image.fromarray(levels, mode="P")
    image.putpalette(palette.tobytes())
    sink = io.BytesIO()
    image.save(sink, "PNG", optimize=True)
    return EmbeddedImage(_data_url("image/png", sink.getvalue()), levels.shape[1], levels.shape[0])


def read_pixels(png: bytes) -> NDArray[np.uint8]:
    """Decodes a stored picture.

    Args:
        png: bytes of a PNG file.

    Returns:
        [H, W, 3] sRGB.
    """
    import numpy as np
    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGB"))


def _data_url(kind: str, data: bytes) -> str:
    # Inside the page, so that the report stays one file.
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
