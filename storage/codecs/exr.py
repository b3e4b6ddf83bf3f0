"""EXR: ZIP, scene-linear half colour, float32 the rest; written whole, checked strictly on read."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import ArtifactCorruptError, ConfigError
from storage.codecs.tables import REMEDY
from storage.files import write_file
from storage.srgb import to_linear_half

EXR_THREADS = 2


@lru_cache(maxsize=1)
def _stop_threads_before_forks() -> None:
    """A fork copies no threads: a child that inherits OpenEXR's pool would wait for it for ever."""
    import OpenEXR

    os.register_at_fork(before=lambda: OpenEXR.set_global_thread_count(0))


def _openexr() -> Any:
    """The module, with its pool of threads started."""
    import OpenEXR

    _stop_threads_before_forks()
    OpenEXR.set_global_thread_count(EXR_THREADS)
    return OpenEXR


def write_channels(path: Path, channels: Mapping[str, NDArray[Any]]) -> None:
    """Write channels [H, W], float16 or float32, as one scan-line part. No timestamps: equal input, equal bytes."""
    OpenEXR = _openexr()
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


def read_channels(path: Path, dtypes: Mapping[str, Any], shape: tuple[int, int]) -> dict[str, NDArray[Any]]:
    """The channels, exactly those of ``dtypes``, each of its dtype and of ``shape`` (H, W).

    A truncated or altered file does not raise in OpenEXR: it has no parts, or channels without pixels. Here each of
    these raises ``ArtifactCorruptError`` naming file and channel.
    """
    OpenEXR = _openexr()

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


def write_exr(
    path: Path,
    color: NDArray[np.float32],  # [H, W, 3] sRGB, premultiplied
    alpha: NDArray[np.float32] | None = None,  # [H, W]; None: opaque
    depth: NDArray[np.float32] | None = None,  # [H, W] metres
) -> None:
    """One display-referred image as a scene-linear EXR with R, G, B and what is given of A and Z."""
    light = to_linear_half(color, alpha, path.name)
    channels: dict[str, NDArray[Any]] = {c: light[..., k] for k, c in enumerate("RGB")}
    channels |= {} if alpha is None else {"A": alpha}
    channels |= {} if depth is None else {"Z": depth}
    write_channels(path, channels)
