"""The address of images with poses: a path, and options for images, up and scale."""

from __future__ import annotations

import math
from pathlib import Path
from urllib.parse import quote

import numpy as np

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.posed_images.colmap_model import find_colmap_model
from genre_tasks.logs.types import Float64

_REMEDY = "Give a transforms.json, a folder that holds one, or the folder of a COLMAP model."


def format_uri(poses: Path, images: Path | None, up: Float64 | None, scale: float | None) -> str:
    """Writes the URI of a log that :func:`open_posed_images` opens.

    Args:
        poses: transforms.json, or a folder.
        images: folder of the images; ``None``: near the poses.
        up: [3] direction in the axes of the poses; ``None``: found.
        scale: metres a unit; ``None``: 1.

    Returns:
        The URI.

    >>> format_uri(Path("a b/transforms.json"), None, np.array([0.0, 0.0, 1.0]), 0.5)
    'posed_images:a%20b/transforms.json?up=0,0,1&scale=0.5'
    """
    options = []
    if images is not None:
        options.append(f"images={quote(str(images))}")
    if up is not None:
        # Six digits are a ten-thousandth of a degree, and the negative zero says nothing.
        options.append("up=" + ",".join(f"{value + 0.0:.6g}" for value in up))
    if scale is not None:
        options.append(f"scale={scale:.6g}")
    return f"posed_images:{quote(str(poses))}" + ("?" + "&".join(options) if options else "")


def parse_direction(text: str) -> Float64:
    """Reads a direction.

    Args:
        text: three numbers with commas.

    Returns:
        [3] unit vector.

    Raises:
        ConfigError: it is no direction.

    >>> parse_direction("0,-2,0").tolist()
    [0.0, -1.0, 0.0]
    """
    try:
        vector = np.array([float(word) for word in text.split(",")])
    except ValueError:
        vector = np.zeros(0)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not math.isfinite(length) or length == 0:
        raise ConfigError(f"'{text}' is no direction", remedy="Write three numbers, such as 0,0,1, or auto.")
    # Adding 0 makes a negative zero a plain one.
    unit: Float64 = vector / length + 0.0
    return unit


def parse_scale(text: str) -> float:
    """Reads metres a unit.

    Args:
        text: a number above 0.

    Raises:
        ConfigError: it is none, or beyond 1e-6 to 1e6.

    >>> parse_scale("2.5")
    2.5
    """
    try:
        scale = float(text)
    except ValueError:
        scale = math.nan
    if not 1e-6 <= scale <= 1e6:
        raise ConfigError(
            f"'{text}' is no scale", remedy="Write metres a unit of the poses, such as 1 or 0.25, or auto."
        )
    return scale


def find_poses(path: Path) -> Path:
    """Finds the file of poses, or the folder of the COLMAP model.

    Args:
        path: that the user names.

    Returns:
        A transforms.json, or a folder with cameras and images of COLMAP.

    Raises:
        InputError: there is neither.
    """
    if path.is_file():
        return path
    if (path / "transforms.json").is_file():
        return path / "transforms.json"
    model = find_colmap_model(path)
    if model is None:
        raise InputError("there are no camera poses", remedy=_REMEDY, file=path)
    return model
