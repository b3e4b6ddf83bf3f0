"""Pairs ↔ ``pairs.parquet``: a row for each pair, its images as PNG (colour, and masks in the place of opacity)."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from genre_tasks.errors import ArtifactCorruptError
from genre_tasks.fixer.inputs import FixerInputs
from genre_tasks.fixer.pairs import INPUT_NAMES, Pairs
from storage.codecs.png import decode_png, encode_png
from storage.codecs.tables import REMEDY, check_array, column, column_array, read_table, schema, write_table

IMAGES: dict[str, tuple[str, ...]] = {
    "render": ("color", "alpha"),
    "lidar": ("lidar_color", "lidar_alpha"),
    "reference": ("reference",),
    "warped": ("warped", "warp_mask"),
    "lidar_warped": ("lidar_warped", "lidar_warp_mask"),
    "doubt": ("warp_spread", "lidar_warp_spread", "depth_gap"),
}
"""Picture → the tensors of ``FixerInputs`` in its channels. Masks are packed where PNG has opacity, to save files."""

_COLOR_TENSORS = {"color", "lidar_color", "reference", "warped", "lidar_warped"}

TABLE = schema(
    "pairs/1",
    [
        column("kind", pa.string(), "how the render came to be degraded"),
        column("shift_m", pa.float32(), "metres beside the path, left is positive, 0 is on it"),
        *(column(name, pa.large_binary(), f"PNG: {', '.join(parts)}") for name, parts in IMAGES.items()),
        column("truth", pa.large_binary(), "PNG"),
    ],
)
_FILE = "pairs.parquet"


def write(folder: Path, value: Pairs) -> None:
    """Writes the table.

    Args:
        folder: an empty folder.
        value: N pairs, uint8 on the CPU.

    Raises:
        ConfigError: a tensor is not uint8, or images differ in size.
    """
    height, width = value.truth.shape[-2:]
    for name in INPUT_NAMES:
        check_array(getattr(value.views, name).numpy(), name, np.uint8, (len(value), None, height, width))
    columns: dict[str, Any] = {"kind": value.kinds, "shift_m": np.asarray(value.shift_m, np.float32)}
    for name, parts in IMAGES.items():
        stacked = torch.cat([getattr(value.views, part) for part in parts], 1)
        columns[name] = [_encode(image) for image in stacked]
    columns["truth"] = [_encode(image) for image in value.truth]
    # PNG is compressed already; compressing it again only costs time.
    write_table(folder / _FILE, TABLE, columns, raw=[*IMAGES, "truth"])


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> Pairs:
    """Reads pairs.

    Args:
        folder: the folder that :func:`write` filled.
        measurements: not used: pairs are all payload.

    Returns:
        The pairs on the CPU.

    Raises:
        ArtifactCorruptError: the table is damaged, or a picture does not decode or has other channels.
    """
    path = folder / _FILE
    table = read_table(path, TABLE)[0]
    tensors: dict[str, Tensor] = {}
    for name, parts in IMAGES.items():
        images = _decode_column(table, name, path)
        counts = [3 if part in _COLOR_TENSORS else 1 for part in parts]
        # Otherwise the split below would fail with an error that names neither file nor column.
        if images.shape[1] != sum(counts):
            raise ArtifactCorruptError(f"{name} has {images.shape[1]} channels", remedy=REMEDY, file=path)
        tensors.update(zip(parts, images.split(counts, 1), strict=True))
    views = FixerInputs(**{name: tensors[name].contiguous() for name in INPUT_NAMES})
    truth = _decode_column(table, "truth", path)
    return Pairs(views, truth, tuple(table.column("kind").to_pylist()), column_array(table, "shift_m"))


def measurements(value: Pairs) -> dict[str, Any]:
    """Selects no measurements: pairs are all payload.

    Returns:
        An empty dictionary.
    """
    return {}


def _encode(image: Tensor) -> bytes:
    return encode_png(image.permute(1, 2, 0).numpy())


def _decode_column(table: pa.Table, name: str, path: Path) -> Tensor:
    """The pictures of a column, [N, C, H, W] uint8."""
    pictures = table.column(name).to_pylist()
    images = [decode_png(io.BytesIO(data), path, name) for data in pictures]
    # A grey picture has no axis of channels, and pictures of several sizes cannot be stacked.
    if not images or len({image.shape for image in images}) > 1 or images[0].ndim != 3:
        problem = f"{name} holds {len(images)} pictures of sizes {sorted({image.shape for image in images})}"
        raise ArtifactCorruptError(problem, remedy=REMEDY, file=path)
    stacked = np.stack(images)
    return torch.from_numpy(np.ascontiguousarray(stacked.transpose(0, 3, 1, 2)))
