"""Images reduced to means over areas, at ratios that are no whole numbers too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

# Rows are reduced by so many at a time: their floating-point numbers then fit the processor's cache.
_ROWS = 32


def average_areas(pixels: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Averages an image over equal areas; pixels on the border of two areas count for their share in each.

    Pillow's box filter takes pixels as a unit instead, which moves the image by up to a quarter of a pixel, here more
    and there less.

    Args:
        pixels: [H, W, C].
        width_px: of the result, at most W.
        height_px: of the result, at most H.

    Returns:
        [height_px, width_px, C], rounded once.

    >>> average_areas(np.array([[[0], [90], [240]]], np.uint8), 2, 1).tolist()
    [[[30], [190]]]
    """
    height, width, channels = pixels.shape
    by_row = _shares(height, height_px)
    by_column = _shares(width, width_px)
    reduced = np.empty((height_px, width_px, channels), np.uint8)
    for begin in range(0, height_px, _ROWS):
        end = min(begin + _ROWS, height_px)
        # Rows of the image that the areas of these rows reach.
        first = begin * height // height_px
        last = -(-end * height // height_px)
        block = pixels[first:last].reshape(last - first, -1).astype(np.float32)
        rows = by_row[begin:end, first:last] @ block
        columns = rows.reshape(end - begin, width, channels).transpose(1, 0, 2).reshape(width, -1)
        means = (by_column @ columns).reshape(width_px, end - begin, channels)
        reduced[begin:end] = np.rint(means).transpose(1, 0, 2)
    return reduced


def _shares(size: int, reduced_size: int) -> csr_array:
    """[reduced_size, size] float32: the share of each pixel of a row in each area's mean."""
    # In units of which a pixel has ``reduced_size`` and an area ``size``, all borders are whole numbers.
    borders = np.union1d(np.arange(size + 1) * reduced_size, np.arange(reduced_size + 1) * size)
    begin = borders[:-1]
    weight = (np.diff(borders) / size).astype(np.float32)
    return csr_array((weight, (begin // size, begin // reduced_size)), shape=(reduced_size, size))
