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
from storage.codecs.exr import map_images, read_channels, write_channels
from storage.codecs.tables import REMEDY, check_array, column, read_table, schema, write_table
from storage.codecs.view_columns import CAMERA_AND_FRAME, LENS_AND_POSE, SHIFT, lens_columns, pose_and_lens
from storage.srgb import from_linear_half, to_linear_half

VIEWS = schema(
    "novel_views/1",
    [
        *CAMERA_AND_FRAME,
        SHIFT,
        *LENS_AND_POSE,
        column("reference_camera", pa.string(), "camera of the nearest source view"),
        column("reference_frame", pa.int64(), "frame of the nearest source view"),
        column("file", pa.string(), "the view's image: scene-linear, premultiplied"),
    ],
)
LAYERS = ("", "lidar.")
"""Prefixes of the channels of the render and of the LiDAR map."""

# Half precision keeps 11 bits: enough for colour, but at 100 m a step of depth would be 6 cm.
_COUNTS = ("culled", "lidar_culled")
CHANNELS: dict[str, Any] = {
    f"{layer}{c}": np.float16 if c in "RGB" else np.float32 for layer in LAYERS for c in ("R", "G", "B", "A", "Z")
}


def view_file_name(index: int, view: NovelView) -> str:
    """Names the image of a view: unique by its number, the rest is for people.

    Args:
        index: number of the view in its table.
        view: the view.

    Returns:
        For instance ``0003_front_camera_frame_0012_+3.00m.exr``.
    """
    # A camera's name may hold anything, and a file's name may not be longer than 255 bytes.
    camera = re.sub(r"[^A-Za-z0-9_-]", "_", view.camera)[:60]
    return f"{index:04d}_{camera}_frame_{view.frame:04d}_{view.shift_m:+.2f}m.exr"


def write_view_table(folder: Path, views: Sequence[NovelView], height: int, width: int) -> list[Path]:
    """Writes ``views.parquet`` and makes the folder for the images.

    Args:
        folder: the artifact's folder.
        views: the views.
        height: height of all images in pixels.
        width: width of all images in pixels.

    Returns:
        Where each view's image belongs.

    Raises:
        NonFiniteError: a pose holds NaN or infinity.
    """
    (folder / "views").mkdir()
    names = [f"views/{view_file_name(i, v)}" for i, v in enumerate(views)]
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


def read_view_table(folder: Path) -> tuple[tuple[NovelView, ...], list[Path], tuple[int, int]]:
    """Reads what :func:`write_view_table` wrote.

    Args:
        folder: the artifact's folder.

    Returns:
        (views, their images' paths, (height, width) of the images in pixels).

    Raises:
        ArtifactCorruptError: the table is damaged, or names a file that is not the view's.
    """
    path = folder / "views.parquet"
    table, extra = read_table(path, VIEWS)
    try:
        shape = (int(extra["height_px"]), int(extra["width_px"]))
    # The size stands in the table, so that a single damaged image cannot define what is expected of it.
    except (KeyError, ValueError) as error:
        raise ArtifactCorruptError("The image size is missing", remedy=REMEDY, file=path) from error
    views = []
    paths = []
    for i, row in enumerate(table.to_pylist()):
        pose, lens = pose_and_lens(row)
        reference = (row["reference_camera"], row["reference_frame"])
        view = NovelView(row["camera"], row["frame"], row["shift_m"], pose, lens, reference)
        # A path from a file is never trusted: it could lead out of the artifact's folder.
        if row["file"] != f"views/{view_file_name(i, view)}":
            raise ArtifactCorruptError(f"Column 'file' holds {row['file']!r}", remedy=REMEDY, file=path)
        views.append(view)
        paths.append(folder / row["file"])
    return tuple(views), paths, shape


def write(folder: Path, value: NovelViews) -> None:
    """Writes the views' table and images. Alpha and depth are exact.

    Args:
        folder: an empty folder.
        value: the rendered views, on any device; colour is kept within :data:`storage.srgb.ROUNDING_BOUND`.

    Raises:
        ConfigError: a tensor has another dtype or shape.
        NonFiniteError: a value is NaN or infinite, or a colour too bright for half precision.
    """
    _, height, width = value.alpha.shape
    layers = {
        "": (value.color, value.alpha, value.depth),
        "lidar.": (value.lidar_color, value.lidar_alpha, value.lidar_depth),
    }
    # All layers are checked before the first file is written, so that an error leaves no images behind.
    arrays = {}
    for layer, (color, alpha, depth) in layers.items():
        name = "LiDAR map" if layer else "render"
        shape = (len(value.views), height, width)
        arrays[layer] = (
            check_array(color.detach().cpu().numpy(), f"{name} colour", np.float32, (*shape, 3)),
            check_array(alpha.detach().cpu().numpy(), f"{name} alpha", np.float32, shape),
            check_array(depth.detach().cpu().numpy(), f"{name} depth", np.float32, shape),
        )

    def write_image(i: int, path: Path) -> None:
        channels: dict[str, Any] = {}
        for layer, (colors, alphas, depths) in arrays.items():
            light = to_linear_half(colors[i], alphas[i], f"colour of {path.name}")
            channels |= {f"{layer}{c}": light[..., k] for k, c in enumerate("RGB")}
            channels |= {f"{layer}A": alphas[i], f"{layer}Z": depths[i]}
        write_channels(path, channels)

    paths = write_view_table(folder, value.views, height, width)
    map_images(write_image, range(len(paths)), paths)


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> NovelViews:
    """Reads rendered views.

    Args:
        folder: the folder that :func:`write` filled.
        measurements: ``culled`` and ``lidar_culled`` from the manifest.

    Returns:
        The views on the CPU, float32, display-referred and premultiplied.

    Raises:
        ArtifactCorruptError: the table or an image is damaged.
    """
    from genre_tasks.image_memory import allocate_images

    views, paths, (height, width) = read_view_table(folder)
    shape = (len(views), height, width)
    # Filled in place: stacking single views at the end would need the memory twice.
    stacks = {layer: (allocate_images(*shape, 3), allocate_images(*shape), allocate_images(*shape)) for layer in LAYERS}
    arrays = {layer: tuple(stack.numpy() for stack in layer_stacks) for layer, layer_stacks in stacks.items()}

    def fill(i: int, path: Path) -> None:
        for layer, images in read_image(path, (height, width)).items():
            for array, image in zip(arrays[layer], images, strict=True):
                array[i] = image

    map_images(fill, range(len(paths)), paths)
    color, alpha, depth = stacks[""]
    lidar_color, lidar_alpha, lidar_depth = stacks["lidar."]
    return NovelViews(
        views=views,
        color=color,
        alpha=alpha,
        depth=depth,
        lidar_color=lidar_color,
        lidar_alpha=lidar_alpha,
        lidar_depth=lidar_depth,
        **{name: dict((measurements or {}).get(name, {})) for name in _COUNTS},
    )


def read_image(path: Path, shape: tuple[int, int]) -> dict[str, tuple[NDArray[np.float32], ...]]:
    """Reads the image of one view.

    Args:
        path: the EXR file.
        shape: the image's (height, width) in pixels.

    Returns:
        Layer → (colour [H, W, 3] in premultiplied sRGB, alpha [H, W], depth [H, W] in metres).

    Raises:
        ArtifactCorruptError: the file does not decode or has another size.
    """
    channels = read_channels(path, CHANNELS, shape)
    layers: dict[str, tuple[NDArray[np.float32], ...]] = {}
    for layer in LAYERS:
        # Alpha goes along, because premultiplied colour has to be divided by it before the sRGB curve is applied.
        light = np.stack([channels[f"{layer}{c}"] for c in "RGB"], -1)
        alpha = channels[f"{layer}A"]
        layers[layer] = (from_linear_half(light, alpha), alpha, channels[f"{layer}Z"])
    return layers


def measurements(value: NovelViews) -> dict[str, Any]:
    """Selects what differs between renderers.

    Args:
        value: the rendered views.

    Returns:
        ``culled`` and ``lidar_culled``: how many Gaussians were not rendered, by reason.
    """
    return {name: dict(getattr(value, name)) for name in _COUNTS}
