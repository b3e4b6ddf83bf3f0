"""Where an artifact came from and what is in it, for people: its ancestors, and tables of statistics of its files."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import ArtifactCorruptError
from storage.codecs.tables import REMEDY
from storage.histograms import draw_histogram
from storage.store import Artifact, Store

_PIXELS_PER_IMAGE = 4096
# Simulations write masks of 8 and 16 bits next to colours; versions of Pillow call 16 bits "I;16" or "I".
_PICTURE_MODES = ("L", "I", "I;16", "RGB", "RGBA")


@dataclass(frozen=True)
class TableSummary:
    """A table for people to read.

    Attributes:
        name: the table's heading.
        rows: dictionaries with the same keys in the same order.
    """

    name: str
    rows: list[dict[str, Any]]


def find_ancestors(store: Store, artifact: Artifact) -> list[Artifact]:
    """Finds all artifacts that an artifact was made from, directly or through others.

    Args:
        store: the store that the artifact is in.
        artifact: the artifact; its manifest names its inputs.

    Returns:
        The ancestors that the store still has, nearest first, each once.
    """
    address = artifact.address
    by_key: dict[str, Artifact] = {}
    for other in store.artifacts(dataset=address.dataset, log=address.log, chunk=address.chunk):
        by_key.setdefault(other.address.key, other)
    found: dict[str, Artifact] = {}
    todo = [artifact]
    while todo:
        # Breadth first, so that near ancestors come before far ones.
        for key in todo.pop(0).manifest.inputs.values():
            if key in by_key and key not in found and key != address.key:
                found[key] = by_key[key]
                todo.append(by_key[key])
    return list(found.values())


def find_descendants(store: Store, artifact: Artifact) -> list[Artifact]:
    """Finds all artifacts that were made from an artifact, directly or through others.

    Args:
        store: the store that the artifact is in.
        artifact: the artifact.

    Returns:
        The descendants of the same chunk, nearest first, each once.
    """
    address = artifact.address
    others = list(store.artifacts(dataset=address.dataset, log=address.log, chunk=address.chunk))
    found: dict[str, Artifact] = {}
    todo = [address.key]
    while todo:
        key = todo.pop(0)
        for other in others:
            if key in other.manifest.inputs.values() and other.address.key not in found:
                found[other.address.key] = other
                todo.append(other.address.key)
    return list(found.values())


def summarise_files(store: Store, artifact: Artifact) -> list[TableSummary]:
    """Summarises every file of an artifact: schema, rows and statistics.

    Args:
        store: the store that the artifact is in.
        artifact: the artifact, which is verified first.

    Returns:
        A summary for each Parquet table, for each folder of EXR images (a row a channel) and for each of PNG pictures.

    Raises:
        ArtifactCorruptError: a file is missing, unexpected or altered.
    """
    store.verify(artifact)
    store.fetch(artifact)
    files = [artifact.path / entry.path for entry in artifact.manifest.files]
    summaries = [_summarise_table(artifact.path, p) for p in files if p.suffix == ".parquet"]
    for folder in sorted({p.parent for p in files if p.suffix == ".exr"}):
        images = [p for p in files if p.parent == folder and p.suffix == ".exr"]
        summaries.append(_summarise_exr(artifact.path, images))
    for folder in sorted({p.parent for p in files if p.suffix == ".png"}):
        pictures = [p for p in files if p.parent == folder and p.suffix == ".png"]
        summaries.append(_summarise_png(artifact.path, pictures))
    return summaries


def _summarise_table(folder: Path, path: Path) -> TableSummary:
    from genre_tasks.bounded_parquet import FOR_COLUMNS, read_bounded_table

    table = read_bounded_table(path, FOR_COLUMNS)
    rows = []
    for field in table.schema:
        note = (field.metadata or {}).get(b"note", b"").decode()
        values = table.column(field.name)
        row = {"column": field.name, "type": str(field.type), "min": "", "mean": "", "max": "", "histogram": ""}
        row["note"] = note
        rows.append(row | _column_statistics(field.type, values))
    return TableSummary(f"{path.relative_to(folder).as_posix()}: {table.num_rows} rows", rows)


def _column_statistics(kind: Any, values: Any) -> dict[str, Any]:
    import pyarrow as pa

    values = values.drop_null()
    if not len(values):
        return {}
    if pa.types.is_string(kind):
        words = values.unique().to_pylist()
        return {"min": min(words), "mean": f"{len(words)} distinct", "max": max(words)}
    if pa.types.is_large_binary(kind):
        return _statistics(np.array([len(v.as_py()) for v in values])) | {"type": "bytes"}
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind):
        return _statistics(values.combine_chunks().to_numpy(zero_copy_only=False))
    return {}


def _statistics(values: NDArray[Any]) -> dict[str, Any]:
    # In double precision, since the mean of a million float32 values would lose digits.
    wide = values.astype(np.float64)
    out = {"min": float(wide.min()), "mean": float(wide.mean()), "max": float(wide.max())}
    out = {k: int(v) if values.dtype.kind in "iu" and k != "mean" and math.isfinite(v) else v for k, v in out.items()}
    return {**out, "histogram": draw_histogram(wide)}


def _summarise_exr(folder: Path, paths: list[Path]) -> TableSummary:
    by_channel: dict[str, dict[str, Any]] = {}
    samples: dict[str, list[NDArray[np.float64]]] = {}
    for path in paths:
        for name, pixels in _read_channels(path):
            row = by_channel.setdefault(
                name,
                {
                    "column": name,
                    "type": f"{pixels.dtype} {pixels.shape[0]}x{pixels.shape[1]}",
                    "min": math.inf,
                    "mean": 0.0,
                    "max": -math.inf,
                    "histogram": "",
                    "note": "metres" if name.endswith("Z") else "linear",
                },
            )
            wide = pixels.astype(np.float64)
            row["min"] = min(row["min"], float(wide.min()))
            row["max"] = max(row["max"], float(wide.max()))
            row["mean"] += float(wide.mean()) / len(paths)
            # Every image gives so many pixels at equal distances, as all of them together may not fit into memory.
            flat = pixels.ravel()
            samples.setdefault(name, []).append(flat[:: max(1, len(flat) // _PIXELS_PER_IMAGE)].astype(np.float64))
    for name, row in by_channel.items():
        row["histogram"] = draw_histogram(np.concatenate(samples[name]))
    heading = f"{paths[0].parent.relative_to(folder).as_posix()}/*.exr: {len(paths)} images"
    return TableSummary(heading, [*by_channel.values()])


def _read_channels(path: Path) -> Iterator[tuple[str, NDArray[Any]]]:
    import OpenEXR

    from storage.codecs.exr import find_size_problems

    with OpenEXR.File(str(path), header_only=True) as file:
        for problem in find_size_problems(file):
            raise ArtifactCorruptError(problem, remedy=REMEDY, file=path)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        if len(file.parts) != 1:
            raise ArtifactCorruptError("The image does not decode", remedy=REMEDY, file=path)
        for name, channel in sorted(file.parts[0].channels.items()):
            yield name, np.array(channel.pixels)


def _summarise_png(folder: Path, paths: list[Path]) -> TableSummary:
    from storage.codecs.png import decode_png

    rows = []
    for path in paths:
        image = decode_png(path, path, "The picture", _PICTURE_MODES)
        rows.append(
            {
                "picture": path.stem,
                "size": f"{image.shape[1]}x{image.shape[0]}",
                "min": int(image.min()),
                "mean": float(image.mean()),
                "max": int(image.max()),
                "histogram": draw_histogram(image.ravel().astype(np.float64)),
            }
        )
    return TableSummary(f"{paths[0].parent.relative_to(folder).as_posix()}/*.png: {len(paths)} pictures", rows)
