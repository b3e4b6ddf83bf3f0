"""What an artifact came from and what is in it, for people: ancestors, tables of statistics, a picture."""

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
from storage.store import Artifact, Store


@dataclass(frozen=True)
class TableSummary:
    """A table for people: ``rows`` are dictionaries with the same keys, in order."""

    name: str
    rows: list[dict[str, Any]]


def ancestors(store: Store, artifact: Artifact) -> list[Artifact]:
    """All artifacts that ``artifact`` was made from, nearest first, each once; those discarded since are left out."""
    at = artifact.address
    by_key: dict[str, Artifact] = {}
    for other in store.artifacts(dataset=at.dataset, log=at.log, chunk=at.chunk):
        by_key.setdefault(other.address.key, other)
    found: dict[str, Artifact] = {}
    todo = [artifact]
    while todo:
        for key in todo.pop(0).manifest.inputs.values():
            if key in by_key and key not in found and key != at.key:
                found[key] = by_key[key]
                todo.append(by_key[key])
    return list(found.values())


def describe(store: Store, artifact: Artifact) -> list[TableSummary]:
    """Schema, rows and statistics of every file, after verification; images are pooled per folder and channel."""
    store.verify(artifact)
    files = [artifact.path / entry.path for entry in artifact.manifest.files]
    out = [_describe_table(artifact.path, p) for p in files if p.suffix == ".parquet"]
    images = sorted({p.parent for p in files if p.suffix == ".exr"})
    out += [_describe_exr(artifact.path, [p for p in files if p.parent == f and p.suffix == ".exr"]) for f in images]
    pictures = [p for p in files if p.suffix == ".png"]
    return out + ([_describe_png(artifact.path, pictures)] if pictures else [])


def _describe_table(folder: Path, path: Path) -> TableSummary:
    import pyarrow.parquet as pq

    with pq.ParquetFile(path, page_checksum_verification=True) as file:
        table = file.read(use_threads=False)
    rows = []
    for field in table.schema:
        note = (field.metadata or {}).get(b"note", b"").decode()
        values = table.column(field.name)
        row = {"column": field.name, "type": str(field.type), "min": "", "mean": "", "max": "", "note": note}
        rows.append(row | _column_statistics(field.type, values))
    return TableSummary(f"{path.relative_to(folder).as_posix()}: {table.num_rows} rows", rows)


def _column_statistics(kind: Any, values: Any) -> dict[str, Any]:
    import pyarrow as pa

    values = values.drop_null()
    if not len(values):
        return {}
    if pa.types.is_string(kind):
        kinds = values.unique().to_pylist()
        return {"min": min(kinds), "mean": f"{len(kinds)} distinct", "max": max(kinds)}
    if pa.types.is_large_binary(kind):
        return _statistics(np.array([len(v.as_py()) for v in values])) | {"type": "bytes"}
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind):
        return _statistics(values.combine_chunks().to_numpy(zero_copy_only=False))
    return {}


def _statistics(values: NDArray[Any]) -> dict[str, Any]:
    wide = values.astype(np.float64)
    out = {"min": float(wide.min()), "mean": float(wide.mean()), "max": float(wide.max())}
    return {k: int(v) if values.dtype.kind in "iu" and k != "mean" and math.isfinite(v) else v for k, v in out.items()}


def _describe_exr(folder: Path, paths: list[Path]) -> TableSummary:
    pooled: dict[str, dict[str, Any]] = {}
    for path in paths:
        for name, pixels in _channels(path):
            row = pooled.setdefault(
                name,
                {"column": name, "type": f"{pixels.dtype} {pixels.shape[0]}x{pixels.shape[1]}"}
                | {
                    "min": math.inf,
                    "mean": 0.0,
                    "max": -math.inf,
                    "note": "metres" if name.endswith("Z") else "linear",
                },
            )
            wide = pixels.astype(np.float64)
            row["min"], row["max"] = min(row["min"], float(wide.min())), max(row["max"], float(wide.max()))
            row["mean"] += float(wide.mean()) / len(paths)
    return TableSummary(
        f"{paths[0].parent.relative_to(folder).as_posix()}/*.exr: {len(paths)} images", [*pooled.values()]
    )


def _channels(path: Path) -> Iterator[tuple[str, NDArray[Any]]]:
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        if len(file.parts) != 1:
            raise ArtifactCorruptError("The image does not decode", remedy=REMEDY, file=path)
        for name, channel in sorted(file.parts[0].channels.items()):
            yield name, np.array(channel.pixels)


def _describe_png(folder: Path, paths: list[Path]) -> TableSummary:
    from storage.codecs.png import read_png

    rows = []
    for path in paths:
        image = read_png(path)
        rows.append({"picture": path.stem, "size": f"{image.shape[1]}x{image.shape[0]}", "mean": float(image.mean())})
    return TableSummary(f"{paths[0].parent.relative_to(folder).as_posix()}/*.png: {len(paths)} pictures", rows)
