"""PNG: lossless sRGB pictures, equal bytes for equal pixels."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import ArtifactCorruptError, ConfigError
from storage.codecs.tables import REMEDY
from storage.files import write_file


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an sRGB image [H, W, 3] uint8, lossless, without timestamps."""
    from PIL import Image

    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ConfigError(
            f"Picture {path.stem} is {image.dtype} {list(image.shape)}, expected uint8 [H, W, 3]",
            remedy="Fix the stage that made this picture.",
        )
    sink = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(sink, "PNG")
    write_file(path, sink.getbuffer())


def read_png(path: Path) -> NDArray[np.uint8]:
    """[H, W, 3] uint8. Raises ``ArtifactCorruptError`` for anything that is no RGB PNG."""
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG"]) as image:
            if image.mode != "RGB":
                raise ArtifactCorruptError(f"The picture has mode {image.mode}, expected RGB", remedy=REMEDY, file=path)
            return np.array(image)
    except (OSError, SyntaxError, ValueError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise ArtifactCorruptError(f"The picture does not decode ({error})", remedy=REMEDY, file=path) from error
