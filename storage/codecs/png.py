"""PNG: lossless sRGB pictures, equal bytes for equal pixels."""

from __future__ import annotations

import io
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import ArtifactCorruptError, ConfigError
from storage.codecs.tables import REMEDY
from storage.files import write_file

if TYPE_CHECKING:
    from torch import Tensor

MAX_PIXELS = 100_000_000
"""Larger pictures are refused before they are decoded."""


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """Encodes an image without timestamps.

    Args:
        image: [H, W, C] uint8 with 3 or 4 channels.

    Returns:
        The bytes of a PNG file.

    >>> encode_png(np.zeros((2, 3, 3), np.uint8))[:4]
    b'\\x89PNG'
    """
    from PIL import Image

    # The same function serves files and table columns, so it makes bytes.
    sink = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(sink, "PNG")
    return sink.getvalue()


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Writes an sRGB image, lossless and without timestamps.

    Args:
        path: the new file.
        image: [H, W, 3] uint8.

    Raises:
        ConfigError: the image has another dtype or shape, or no pixel.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ConfigError(
            f"Picture {path.stem} is {image.dtype} {list(image.shape)}, expected uint8 [H, W, 3]",
            remedy="Fix the stage that made this picture.",
        )
    write_file(path, encode_png(image))


def read_png(path: Path) -> NDArray[np.uint8]:
    """Reads an sRGB image.

    Args:
        path: the file.

    Returns:
        [H, W, 3] uint8.

    Raises:
        ArtifactCorruptError: the file is no RGB PNG, or does not decode.
    """
    # Converting a grey or palette image would succeed, and hide that another program wrote it.
    return decode_png(path, path, "The picture", modes=("RGB",))


def decode_png(
    source: Path | BinaryIO, file: Path, name: str, modes: Collection[str] = ("L", "RGB", "RGBA")
) -> NDArray[Any]:
    """Decodes a picture of at most ``MAX_PIXELS``.

    Args:
        source: the file, or the bytes of one.
        file: that errors name.
        name: that errors call the picture.
        modes: Pillow's names of the channels that it may have.

    Returns:
        [H, W] or [H, W, C] uint8, or wider integers where ``modes`` has "I" or "I;16".

    Raises:
        ArtifactCorruptError: it is no such PNG, is too large, or does not decode.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            # The size is checked below.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            # Only this format: other decoders need not see a file that claims to be a PNG.
            # From memory: of a file, Pillow asks for as many bytes at once as a damaged chunk claims to have left.
            data = io.BytesIO(source.read_bytes()) if isinstance(source, Path) else source
            with Image.open(data, formats=["PNG"]) as image:
                if image.mode not in modes:
                    problem = f"{name} has mode {image.mode}, expected {' or '.join(modes)}"
                    raise ArtifactCorruptError(problem, remedy=REMEDY, file=file)
                # A few kilobytes of zeros can be unpacked to gigabytes.
                if image.width * image.height > MAX_PIXELS:
                    problem = f"{name} has {image.width} × {image.height} pixels"
                    raise ArtifactCorruptError(problem, remedy=REMEDY, file=file)
                return np.array(image)
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError) as error:
        # Pillow raises OSError without a number for damage; one with a number is the operating system's.
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise ArtifactCorruptError(f"{name} does not decode ({error})", remedy=REMEDY, file=file) from error


def to_pixels(color: Tensor) -> NDArray[np.uint8]:
    """Rounds colours to bytes.

    Args:
        color: [..., 3] sRGB; what is outside of [0, 1] becomes the nearest end.

    Returns:
        [..., 3] sRGB.

    >>> import torch
    >>> to_pixels(torch.tensor([[-0.1, 0.5, 1.0]])).tolist()
    [[0, 128, 255]]
    """
    # Rounded, because a plain cast truncates and darkens every image by half a level.
    pixels: NDArray[np.uint8] = (color.clamp(0, 1) * 255).round().byte().cpu().numpy()
    return pixels
