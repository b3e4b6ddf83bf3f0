"""FixedViews ↔ ``views.parquet`` and one opaque EXR (R, G, B) a view."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.scene.novel_views import FixedViews
from storage.codecs.exr import map_images, read_channels, write_exr
from storage.codecs.novel_views import read_view_table, write_view_table
from storage.codecs.tables import check_array
from storage.srgb import from_linear_half

# No alpha and no depth: the fixer paints every pixel, and its depth is not known.
CHANNELS: dict[str, Any] = dict.fromkeys("RGB", np.float16)


def write(folder: Path, value: FixedViews) -> None:
    """Writes the views' table and images; colour is kept within :data:`storage.srgb.ROUNDING_BOUND`.

    Args:
        folder: an empty folder.
        value: the images, on any device.

    Raises:
        ConfigError: the colour has another dtype or shape.
        NonFiniteError: a colour is NaN, infinite or too bright for half precision.
    """
    _, height, width, _ = value.color.shape
    color = check_array(
        value.color.detach().cpu().numpy(), "fixed colour", np.float32, (len(value.views), height, width, 3)
    )
    map_images(write_exr, write_view_table(folder, value.views, height, width), color)


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> FixedViews:
    """Reads fixed views.

    Args:
        folder: the folder that :func:`write` filled.
        measurements: ``copied`` and ``seconds_saved`` from the manifest.

    Returns:
        The images on the CPU, float32, display-referred.

    Raises:
        ArtifactCorruptError: the table or an image is damaged.
    """
    from genre_tasks.image_memory import allocate_images

    views, paths, (height, width) = read_view_table(folder)
    # Filled in place: stacking the images at the end would need the memory twice.
    color = allocate_images(len(views), height, width, 3)
    pixels = color.numpy()

    def fill(i: int, path: Path) -> None:
        pixels[i] = read_image(path, (height, width))

    map_images(fill, range(len(paths)), paths)
    # The fixer writes these entries only where it copied a view.
    known = measurements or {}
    return FixedViews(views, color, tuple(known.get("copied", ())), float(known.get("seconds_saved", 0.0)))


def read_image(path: Path, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Reads the image of one view.

    Args:
        path: the EXR file.
        shape: the image's (height, width) in pixels.

    Returns:
        [H, W, 3] float32 sRGB.

    Raises:
        ArtifactCorruptError: the file does not decode or has another size.
    """
    channels = read_channels(path, CHANNELS, shape)
    return from_linear_half(np.stack([channels[c] for c in "RGB"], -1), None)


def measurements(value: FixedViews) -> dict[str, Any]:
    """Selects what the fixer did, which is not in the images.

    Args:
        value: the fixed views.

    Returns:
        ``copied``: which views are copies of their renders, and ``seconds_saved`` by that; nothing without copies.
    """
    return {"copied": list(value.copied), "seconds_saved": value.seconds_saved} if value.copied else {}
