"""EXR: ZIP, scene-linear half colour, float32 the rest; written completely, checked strictly on read."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import ArtifactCorruptError, ConfigError
from storage.codecs.tables import REMEDY
from storage.files import write_file
from storage.srgb import to_linear_half

Result = TypeVar("Result")

# More threads do not pay for images of this size, and stages run beside each other.
EXR_THREADS = 2

MAX_PIXELS = 100_000_000
"""Of all channels together; images of more are refused before they are decoded."""


@lru_cache(maxsize=1)
def _stop_threads_before_forks() -> None:
    """A fork copies no threads: a child that inherits OpenEXR's pool would wait for it for ever."""
    import OpenEXR

    os.register_at_fork(before=lambda: OpenEXR.set_global_thread_count(0))


def _load_openexr() -> Any:
    """The module, with its pool of threads started."""
    import OpenEXR

    _stop_threads_before_forks()
    OpenEXR.set_global_thread_count(EXR_THREADS)
    return OpenEXR


def map_images(function: Callable[..., Result], *items: Iterable[Any]) -> list[Result]:
    """Reads or writes several images at a time: most of the work is in code that runs beside other threads.

    Args:
        function: of one image.
        items: its arguments, as for ``map``.

    Returns:
        What it returns for each image, in order.

    Raises:
        Exception: what ``function`` raises for the first image that fails.

    >>> map_images(pow, [2, 3], [2, 2])
    [4, 9]
    """
    with ThreadPoolExecutor(EXR_THREADS) as pool:
        return list(pool.map(function, *items))


def write_channels(path: Path, channels: Mapping[str, NDArray[Any]]) -> None:
    """Writes channels as one scan-line part. Equal input gives equal bytes: there is no timestamp.

    Args:
        path: the new file.
        channels: name → pixels [H, W], float16 or float32, all of one size.

    Raises:
        ConfigError: a channel has another dtype, is not two-dimensional or has no pixel.
    """
    OpenEXR = _load_openexr()
    for name, pixels in channels.items():
        if pixels.dtype not in (np.float16, np.float32) or pixels.ndim != 2 or 0 in pixels.shape:
            raise ConfigError(
                f"Channel {name} is {pixels.dtype} {list(pixels.shape)}, expected float16 or float32 [H, W]",
                remedy="Fix the stage that made this image: sizes are at least 1 × 1.",
            )
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    # Written in memory first, so that the file itself is written and synced like all others.
    sink = io.BytesIO()
    # Sorted, so that the order in which a caller lists channels does not change the bytes.
    with OpenEXR.File(header, {k: np.ascontiguousarray(channels[k]) for k in sorted(channels)}) as file:
        file.write(sink)
    write_file(path, sink.getbuffer())


def read_channels(path: Path, dtypes: Mapping[str, Any], shape: tuple[int, int]) -> dict[str, NDArray[Any]]:
    """Reads channels, exactly those that are expected.

    Args:
        path: the EXR file.
        dtypes: name → dtype of each channel.
        shape: (height, width) in pixels.

    Returns:
        Name → pixels [H, W].

    Raises:
        ArtifactCorruptError: the file is missing, truncated or altered, or has other channels, dtypes or sizes.
    """
    OpenEXR = _load_openexr()

    def corrupt(problem: str) -> ArtifactCorruptError:
        return ArtifactCorruptError(problem, remedy=REMEDY, file=path)

    if not path.is_file():
        raise corrupt("An image is missing")
    # OpenEXR does not raise for a truncated or altered file: it has no parts, or channels without pixels.
    try:
        # The header first: a file of zeros can be unpacked to a thousand times its size.
        with OpenEXR.File(str(path), header_only=True) as file:
            for problem in find_size_problems(file, shape):
                raise corrupt(problem)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            if len(file.parts) != 1:
                raise corrupt(f"The image has {len(file.parts)} parts, expected 1")
            # Copied, because the arrays of OpenEXR die with the file.
            found = {name: np.array(c.pixels) for name, c in file.parts[0].channels.items() if c.pixels is not None}
    except (RuntimeError, ValueError, TypeError) as error:
        raise corrupt(f"The image does not decode ({error})") from error
    if set(found) != set(dtypes):
        raise corrupt(f"The image has channels {sorted(found)}, expected {sorted(dtypes)}")
    for name, dtype in dtypes.items():
        # Converting silently would hide that another program has rewritten the file with less precision.
        if found[name].dtype != np.dtype(dtype) or found[name].shape != shape:
            raise corrupt(
                f"Channel {name} is {found[name].dtype} {found[name].shape}, expected {np.dtype(dtype)} {shape}"
            )
    return found


def find_size_problems(file: Any, shape: tuple[int, int] | None = None) -> Iterator[str]:
    """Finds what of an image's header would make reading it take other memory than expected.

    Args:
        file: of OpenEXR, opened for its header alone.
        shape: (height, width) in pixels; ``None``: any of at most ``MAX_PIXELS``.

    Yields:
        Problems, one sentence each.
    """
    for part in file.parts:
        low, high = (corner.tolist() for corner in part.header["dataWindow"])
        width, height = (high[axis] - low[axis] + 1 for axis in (0, 1))
        if shape is not None and (height, width) != shape:
            yield f"The image has (height, width) {(height, width)}, expected {shape}"
        if height * width * len(part.header["channels"]) > MAX_PIXELS:
            yield f"The image has {len(part.header['channels'])} channels of {height} × {width} pixels"


def write_exr(
    path: Path,
    color: NDArray[np.float32],  # [H, W, 3] sRGB, premultiplied
    alpha: NDArray[np.float32] | None = None,  # [H, W]
    depth: NDArray[np.float32] | None = None,  # [H, W] metres
) -> None:
    """Writes one display-referred image as a scene-linear EXR, for other programs to open.

    Args:
        path: the new file.
        color: [H, W, 3] sRGB, premultiplied; channels R, G, B.
        alpha: [H, W] in [0, 1], channel A; ``None`` for an opaque image.
        depth: [H, W] in metres, channel Z, if there is one.

    Raises:
        NonFiniteError: a colour is NaN, infinite or too bright for half precision.
    """
    light = to_linear_half(color, alpha, path.name)
    channels: dict[str, NDArray[Any]] = {c: light[..., k] for k, c in enumerate("RGB")}
    if alpha is not None:
        channels["A"] = alpha
    if depth is not None:
        channels["Z"] = depth
    write_channels(path, channels)
