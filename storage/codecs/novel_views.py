"""NovelViews ↔ ``views.parquet`` and one EXR a view: R, G, B, A, Z of the render and ``lidar.*`` of the LiDAR map.

Culled counts are measurements: they live in the manifest and come back from there.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from genre_tasks.errors import ArtifactCorruptError
from genre_tasks.scene.novel_views import NovelView, NovelViews
from storage.codecs.exr import read_channels, write_channels
from storage.codecs.lenses import LENS_AND_POSE, lens_columns, pose_and_lens
from storage.codecs.tables import REMEDY, checked, column, read_table, schema, write_table
from storage.srgb import from_linear_half, to_linear_half

VIEWS = schema(
    "novel_views/1",
    [
        column("camera", pa.string(), "name"),
        column("frame", pa.int64(), "frame of the log"),
        column("shift_m", pa.float64(), "metres, left is positive"),
        *LENS_AND_POSE,
        column("reference_camera", pa.string(), "camera of the nearest source view"),
        column("reference_frame", pa.int64(), "frame of the nearest source view"),
        column("file", pa.string(), "the view's image: scene-linear, premultiplied"),
    ],
)
LAYERS = ("", "lidar.")
_COUNTS = ("culled", "lidar_culled")
CHANNELS: dict[str, Any] = {
    f"{layer}{c}": np.float16 if c in "RGB" else np.float32 for layer in LAYERS for c in ("R", "G", "B", "A", "Z")
}


def file_name(index: int, view: NovelView) -> str:
    """``0003_front_camera_frame_0012_+3.00m.exr``: unique by its number, the rest is for people."""
    camera = re.sub(r"[^A-Za-z0-9_-]", "_", view.camera)[:60]
    return f"{index:04d}_{camera}_frame_{view.frame:04d}_{view.shift_m:+.2f}m.exr"


def write_views(folder: Path, views: Sequence[NovelView], height: int, width: int) -> list[Path]:
    """Write ``views.parquet`` and return where each view's image belongs."""
    (folder / "views").mkdir()
    names = [f"views/{file_name(i, v)}" for i, v in enumerate(views)]
    columns = {
        "camera": [v.camera for v in views],
        "frame": [v.frame for v in views],
        "shift_m": [v.shift_m for v in views],
        **lens_columns([v.chunk_SE3_camera for v in views], [v.lens for v in views]),
        "reference_camera": [v.reference[0] for v in views],
        "reference_frame": [v.reference[1] for v in views],
        "file": names,
    }
    write_table(folder / "views.parquet", VIEWS, columns, {"height_px": str(height), "width_px": str(width)})
    return [folder / name for name in names]


def read_views(folder: Path) -> tuple[tuple[NovelView, ...], list[Path], tuple[int, int]]:
    """The views, their images' paths and the image size (H, W)."""
    path = folder / "views.parquet"
    table, extra = read_table(path, VIEWS)
    try:
        shape = (int(extra["height_px"]), int(extra["width_px"]))
    except (KeyError, ValueError) as error:
        raise ArtifactCorruptError("The image size is missing", remedy=REMEDY, file=path) from error
    views, files = [], []
    for i, row in enumerate(table.to_pylist()):
        pose, lens = pose_and_lens(row)
        reference = (row["reference_camera"], row["reference_frame"])
        view = NovelView(row["camera"], row["frame"], row["shift_m"], pose, lens, reference)
        if row["file"] != f"views/{file_name(i, view)}":
            raise ArtifactCorruptError(f"Column 'file' holds {row['file']!r}", remedy=REMEDY, file=path)
        views.append(view)
        files.append(folder / row["file"])
    return tuple(views), files, shape


def write(folder: Path, value: NovelViews) -> None:
    """Write the views' table and images. Alpha and depth are exact; colour is within the rounding bound."""
    _, height, width = value.alpha.shape
    layers = {
        "": (value.color, value.alpha, value.depth),
        "lidar.": (value.lidar_color, value.lidar_alpha, value.lidar_depth),
    }
    arrays = {}
    for layer, (color, alpha, depth) in layers.items():
        name = "LiDAR map" if layer else "render"
        full = (len(value.views), height, width)
        arrays[layer] = (
            checked(color.detach().cpu().numpy(), f"{name} colour", np.float32, (*full, 3)),
            checked(alpha.detach().cpu().numpy(), f"{name} alpha", np.float32, full),
            checked(depth.detach().cpu().numpy(), f"{name} depth", np.float32, full),
        )
    for i, path in enumerate(write_views(folder, value.views, height, width)):
        channels: dict[str, Any] = {}
        for layer, (colors, alphas, depths) in arrays.items():
            light = to_linear_half(colors[i], alphas[i], f"colour of {path.name}")
            channels |= {f"{layer}{c}": light[..., k] for k, c in enumerate("RGB")}
            channels |= {f"{layer}A": alphas[i], f"{layer}Z": depths[i]}
        write_channels(path, channels)


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> NovelViews:
    """The views on the CPU, float32, display-referred and premultiplied."""
    import torch

    views, files, (height, width) = read_views(folder)
    shape = (len(views), height, width)
    out = {
        layer: (np.empty((*shape, 3), np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32))
        for layer in LAYERS
    }
    for i, path in enumerate(files):
        for layer, (color, alpha, depth) in read_image(path, (height, width)).items():
            out[layer][0][i], out[layer][1][i], out[layer][2][i] = color, alpha, depth
    render, lidar = ([torch.from_numpy(a) for a in out[layer]] for layer in LAYERS)
    counts = [dict((measurements or {}).get(name, {})) for name in _COUNTS]
    return NovelViews(views, render[0], render[1], render[2], lidar[0], lidar[1], lidar[2], *counts)


def read_image(path: Path, shape: tuple[int, int]) -> dict[str, tuple[NDArray[np.float32], ...]]:
    """One view: layer → colour [H, W, 3] (sRGB, premultiplied), alpha [H, W], depth [H, W]."""
    channels = read_channels(path, CHANNELS, shape)
    out: dict[str, tuple[NDArray[np.float32], ...]] = {}
    for layer in LAYERS:
        light, alpha = np.stack([channels[f"{layer}{c}"] for c in "RGB"], -1), channels[f"{layer}A"]
        out[layer] = (from_linear_half(light, alpha), alpha, channels[f"{layer}Z"])
    return out


def measurements(value: NovelViews) -> dict[str, Any]:
    """Culled counts of the scene and of the LiDAR map."""
    return {name: dict(getattr(value, name)) for name in _COUNTS}
