"""Pairs ↔ ``pairs.parquet``: a row for each pair, its images as PNG (colour, and masks in the place of opacity)."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from torch import Tensor

from genre_tasks.errors import ArtifactCorruptError
from genre_tasks.fixer.conditioning import Degraded
from genre_tasks.fixer.pairs import NAMES, Pairs
from storage.codecs.tables import REMEDY, array_of, checked, column, read_table, schema, write_table

IMAGES: dict[str, tuple[str, ...]] = {
    "render": ("color", "alpha"),
    "lidar": ("lidar_color", "lidar_alpha"),
    "reference": ("reference",),
    "warped": ("warped", "warp_mask"),
    "lidar_warped": ("lidar_warped", "lidar_warp_mask"),
    "doubt": ("warp_spread", "lidar_warp_spread", "depth_gap"),
}
"""Picture → the tensors of ``Degraded`` in its channels."""

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
    """Write the table. Raises ``ConfigError`` for other types than bytes and for mixed sizes."""
    height, width = value.truth.shape[-2:]
    for name in NAMES:
        checked(getattr(value.views, name).numpy(), name, np.uint8, (len(value), None, height, width))
    columns: dict[str, Any] = {"kind": value.kinds, "shift_m": np.asarray(value.shift_m, np.float32)}
    for name, parts in IMAGES.items():
        stacked = torch.cat([getattr(value.views, part) for part in parts], 1)
        columns[name] = [_encoded(image) for image in stacked]
    columns["truth"] = [_encoded(image) for image in value.truth]
    write_table(folder / _FILE, TABLE, columns, raw=[*IMAGES, "truth"])


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> Pairs:
    """The pairs. Raises ``ArtifactCorruptError`` for a picture that does not decode or has other channels."""
    path = folder / _FILE
    table = read_table(path, TABLE)[0]
    tensors: dict[str, Tensor] = {}
    for name, parts in IMAGES.items():
        images = _decoded(table, name, path)
        counts = [3 if part in _COLOURS else 1 for part in parts]
        if images.shape[1] != sum(counts):
            raise ArtifactCorruptError(f"{name} has {images.shape[1]} channels", remedy=REMEDY, file=path)
        tensors.update(zip(parts, images.split(counts, 1), strict=True))
    views = Degraded(**{name: tensors[name].contiguous() for name in NAMES})
    return Pairs(
        views, _decoded(table, "truth", path), tuple(table.column("kind").to_pylist()), array_of(table, "shift_m")
    )


_COLOURS = {"color", "lidar_color", "reference", "warped", "lidar_warped"}


def measurements(value: Pairs) -> dict[str, Any]:
    """None."""
    return {}


def _encoded(image: Tensor) -> bytes:
    from PIL import Image

    sink = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image.permute(1, 2, 0).numpy())).save(sink, "PNG")
    return sink.getvalue()


def _decoded(table: pa.Table, name: str, path: Path) -> Tensor:
    from PIL import Image

    images: list[NDArray[np.uint8]] = []
    try:
        for data in table.column(name).to_pylist():
            with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
                images.append(np.array(image))
        stacked = np.stack(images)
    except (OSError, SyntaxError, ValueError) as error:
        raise ArtifactCorruptError(f"{name} does not decode ({error})", remedy=REMEDY, file=path) from error
    return torch.from_numpy(np.ascontiguousarray(stacked.transpose(0, 3, 1, 2)))
