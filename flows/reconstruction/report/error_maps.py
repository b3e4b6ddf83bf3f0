"""Maps of |render − truth|: where an image departs from what it should show, and by how much."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

from flows.reconstruction.report.photos import EmbeddedImage, embed_map, read_pixels

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_ERROR = 0.2
"""End of the scale, as a fraction of full brightness. It is the same for all maps, so that they can be compared."""

_LEVELS = 64
_COLOR_MAP = "inferno"


@dataclass(frozen=True)
class ErrorMap:
    """The difference of two images.

    Attributes:
        image: the map in colours.
        mean: mean absolute difference over pixels and channels, as a fraction of full brightness.
        psnr: dB; infinite where the images are equal.
    """

    image: EmbeddedImage
    mean: float
    psnr: float

    @property
    def words(self) -> str:
        """Both numbers for readers.

        >>> ErrorMap(EmbeddedImage("", 2, 2), 0.0, math.inf).words
        'no difference'
        """
        if math.isinf(self.psnr):
            return "no difference"
        return f"mean {self.mean:.3f} · {self.psnr:.1f} dB"


def make_error_map(png: bytes, other_png: bytes) -> ErrorMap | None:
    """Compares two stored pictures of the same viewpoint.

    Args:
        png: bytes of a PNG file.
        other_png: the same of the picture to compare with.

    Returns:
        The map, or ``None`` where the sizes differ.
    """
    pixels = read_pixels(png)
    other = read_pixels(other_png)
    return compare_pixels(pixels, other) if pixels.shape == other.shape else None


def compare_pixels(pixels: NDArray[np.uint8], other: NDArray[np.uint8]) -> ErrorMap:
    """Compares two images of one size.

    Args:
        pixels: [H, W, 3] sRGB.
        other: [H, W, 3] sRGB.

    Returns:
        The map of the mean absolute difference of the channels.
    """
    difference = _difference(pixels, other)
    mean_square = float((difference**2).mean())
    psnr = math.inf if mean_square == 0 else -10 * math.log10(mean_square)
    return ErrorMap(embed_map(_choose_levels(difference), error_palette()), float(difference.mean()), psnr)


def color_errors(pixels: NDArray[np.uint8], other: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Draws the same map as an image.

    Args:
        pixels: [H, W, 3] sRGB.
        other: [H, W, 3] sRGB.

    Returns:
        [H, W, 3] sRGB in the colours of the scale.
    """
    return error_palette()[_choose_levels(_difference(pixels, other))]


@cache
def error_palette() -> NDArray[np.uint8]:
    """The colours of the scale.

    Returns:
        [64, 3] sRGB, from no error to :data:`MAX_ERROR` and more.
    """
    import numpy as np
    from matplotlib import colormaps

    return (colormaps[_COLOR_MAP](np.linspace(0, 1, _LEVELS))[:, :3] * 255).round().astype(np.uint8)


def describe_scale(stops: int = 9) -> str:
    """The colours of the scale, as CSS lists the stops of a gradient.

    Args:
        stops: how many colours.

    Returns:
        Colours separated by commas.

    >>> describe_scale(2)
    '#000004, #fcffa4'
    """
    palette = error_palette()
    rows = [round(k * (len(palette) - 1) / (stops - 1)) for k in range(stops)]
    return ", ".join("#" + bytes(palette[row]).hex() for row in rows)


def _difference(pixels: NDArray[np.uint8], other: NDArray[np.uint8]) -> NDArray[np.float64]:
    """[H, W, 3] in [0, 1]."""
    import numpy as np

    return np.abs(pixels.astype(np.float64) - other.astype(np.float64)) / 255


def _choose_levels(difference: NDArray[np.float64]) -> NDArray[np.uint8]:
    """[H, W] row of the palette."""
    import numpy as np

    return np.clip(difference.mean(2) / MAX_ERROR * (_LEVELS - 1), 0, _LEVELS - 1).round().astype(np.uint8)
