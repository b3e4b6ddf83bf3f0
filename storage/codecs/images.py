"""EXR (ZIP, half colour, float32 the rest) and PNG: written whole, checked strictly on read."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import ArtifactCorruptError, ConfigError
from storage.codecs.tables import REMEDY
from storage.files import write_file

EXR_THREADS = 2


def write_exr(path: Path, channels: Mapping[str, NDArray[Any]]) -> None:
    """Write channels [H, W], float16 or float32, as one scan-line part. No timestamps: equal input, equal bytes."""
    import OpenEXR

    OpenEXR.set_global_thread_count(EXR_THREADS)
    for name, pixels in channels.items():
        if pixels.dtype not in (np.float16, np.float32) or pixels.ndim != 2 or 0 in pixels.shape:
            raise ConfigError(
                f"Channel {name} is {pixels.dtype} {list(pixels.shape)}, expected float16 or float32 [H, W]",
                remedy="Fix the stage that made this image: sizes are at least 1 × 1.",
            )
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    sink = io.BytesIO()
    with OpenEXR.File(header, {k: np.ascontiguousarray(channels[k]) for k in sorted(channels)}) as file:
        file.write(sink)
    write_file(path, sink.getbuffer())


def read_exr(path: Path, dtypes: Mapping[str, Any], shape: tuple[int, int]) -> dict[str, NDArray[Any]]:
    """The channels, exactly those of ``dtypes``, each of its dtype and of ``shape`` (H, W).

    A truncated or altered file does not raise in OpenEXR: it has no parts, or channels without pixels. Here each of
    these raises ``ArtifactCorruptError`` naming file and channel.
    """
    import OpenEXR

    OpenEXR.set_global_thread_count(EXR_THREADS)

    def corrupt(problem: str) -> ArtifactCorruptError:
        return ArtifactCorruptError(problem, remedy=REMEDY, file=path)

    if not path.is_file():
        raise corrupt("An image is missing")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            if len(file.parts) != 1:
                raise corrupt(f"The image has {len(file.parts)} parts, expected 1")
            found = {name: np.array(c.pixels) for name, c in file.parts[0].channels.items() if c.pixels is not None}
    except (RuntimeError, ValueError, TypeError) as error:
        raise corrupt(f"The image does not decode ({error})") from error
    if set(found) != set(dtypes):
        raise corrupt(f"The image has channels {sorted(found)}, expected {sorted(dtypes)}")
    for name, dtype in dtypes.items():
        if found[name].dtype != np.dtype(dtype) or found[name].shape != shape:
            raise corrupt(
                f"Channel {name} is {found[name].dtype} {found[name].shape}, expected {np.dtype(dtype)} {shape}"
            )
    return found


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
