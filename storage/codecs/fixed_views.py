"""FixedViews ↔ ``views.parquet`` and one opaque EXR (R, G, B) a view."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.scene.novel_views import FixedViews
from storage.codecs.exr import read_channels, write_exr
from storage.codecs.novel_views import read_views, write_views
from storage.codecs.tables import checked
from storage.srgb import from_linear_half

CHANNELS: dict[str, Any] = dict.fromkeys("RGB", np.float16)


def write(folder: Path, value: FixedViews) -> None:
    """Write the views' table and images; colour is within the rounding bound."""
    _, height, width, _ = value.color.shape
    color = checked(
        value.color.detach().cpu().numpy(), "fixed colour", np.float32, (len(value.views), height, width, 3)
    )
    for i, path in enumerate(write_views(folder, value.views, height, width)):
        write_exr(path, color[i])


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> FixedViews:
    """The images on the CPU, float32, display-referred."""
    import torch

    views, files, (height, width) = read_views(folder)
    color = np.empty((len(views), height, width, 3), np.float32)
    for i, path in enumerate(files):
        color[i] = read_image(path, (height, width))
    known = measurements or {}
    return FixedViews(
        views, torch.from_numpy(color), tuple(known.get("copied", ())), float(known.get("seconds_saved", 0.0))
    )


def read_image(path: Path, shape: tuple[int, int]) -> NDArray[np.float32]:
    """One image, [H, W, 3] sRGB."""
    channels = read_channels(path, CHANNELS, shape)
    return from_linear_half(np.stack([channels[c] for c in "RGB"], -1), None)


def measurements(value: FixedViews) -> dict[str, Any]:
    """Which views are copies of their renders, and the time that saved."""
    return {"copied": list(value.copied), "seconds_saved": value.seconds_saved} if value.copied else {}
