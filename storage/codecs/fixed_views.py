"""FixedViews ↔ ``views.parquet`` and one opaque EXR (R, G, B) a view."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.scene.views import FixedViews
from storage.codecs.images import read_exr, write_exr
from storage.codecs.novel_views import read_views, write_views
from storage.codecs.tables import checked
from storage.color import from_linear_half, to_linear_half

CHANNELS: dict[str, Any] = dict.fromkeys("RGB", np.float16)


def write(folder: Path, value: FixedViews) -> None:
    """Write the views' table and images; colour is within the rounding bound."""
    _, height, width, _ = value.color.shape
    color = checked(
        value.color.detach().cpu().numpy(), "fixed colour", np.float32, (len(value.views), height, width, 3)
    )
    for i, path in enumerate(write_views(folder, value.views, height, width)):
        light = to_linear_half(color[i], None, f"colour of {path.name}")
        write_exr(path, {c: light[..., k] for k, c in enumerate("RGB")})


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> FixedViews:
    """The images on the CPU, float32, display-referred."""
    import torch

    views, files, (height, width) = read_views(folder)
    color = np.empty((len(views), height, width, 3), np.float32)
    for i, path in enumerate(files):
        channels = read_exr(path, CHANNELS, (height, width))
        color[i] = from_linear_half(np.stack([channels[c] for c in "RGB"], -1), None)
    return FixedViews(views, torch.from_numpy(color))


def measurements(value: FixedViews) -> dict[str, Any]:
    """None."""
    return {}
