"""Evaluation ↔ ``metrics.parquet``, ``views.parquet``, ``curve.parquet`` and ``pictures/*.png``.

Infinite and undefined scores are kept as they are: the PSNR of identical images is infinite.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from genre_tasks.errors import ArtifactCorruptError, ConfigError
from genre_tasks.metrics.results import Evaluation, Metric, ViewScore
from storage.codecs.png import read_png, write_png
from storage.codecs.tables import REMEDY, column, read_table, schema, write_table

METRICS = schema(
    "metrics/1",
    [
        column("name", pa.string(), "interpolation/psnr, shift_3m/kernel"),
        column("value", pa.float64(), "in the metric's unit"),
        column("n", pa.int64(), "images"),
        column("low", pa.float64(), "lower end of the 95 % interval", nullable=True),
        column("high", pa.float64(), "upper end of the 95 % interval", nullable=True),
    ],
)
SCORES = schema(
    "view_scores/1",
    [
        column("camera", pa.string(), "name"),
        column("frame", pa.int64(), "frame of the log"),
        column("shift_m", pa.float64(), "metres, left is positive"),
        column("psnr", pa.float64(), "dB"),
        column("ssim", pa.float64(), "at most 1"),
        column("perceptual", pa.float64(), "0 is equal"),
    ],
)
CURVE = schema(
    "curve/1",
    [column("iteration", pa.int64(), "iterations done"), column("psnr", pa.float64(), "dB, held-out frames")],
)
_NAME = re.compile(r"[A-Za-z0-9_+=-][A-Za-z0-9_.+=-]{0,180}")


def write(folder: Path, value: Evaluation) -> None:
    """Write the tables and the pictures."""
    metrics = {name: [getattr(m, name) for m in value.metrics] for name in METRICS.names}
    write_table(folder / "metrics.parquet", METRICS, metrics, {"stage": value.stage})
    write_table(
        folder / "views.parquet", SCORES, {name: [getattr(v, name) for v in value.views] for name in SCORES.names}
    )
    curve = {"iteration": [i for i, _ in value.curve], "psnr": [p for _, p in value.curve]}
    write_table(folder / "curve.parquet", CURVE, curve)
    if value.pictures:
        (folder / "pictures").mkdir()
    for name, image in sorted(value.pictures.items()):
        if not _NAME.fullmatch(name):
            raise ConfigError(
                f"The picture's name {name!r} cannot be a file's name", remedy="Use letters, digits and _ . + = - only."
            )
        write_png(folder / "pictures" / f"{name}.png", image)


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> Evaluation:
    """The evaluation, pictures in the order of their names."""
    metrics, extra = read_table(folder / "metrics.parquet", METRICS)
    if "stage" not in extra:
        raise ArtifactCorruptError("The stage is missing", remedy=REMEDY, file=folder / "metrics.parquet")
    curve = read_table(folder / "curve.parquet", CURVE)[0]
    below = folder / "pictures"
    paths = sorted(below.iterdir()) if below.is_dir() else []
    return Evaluation(
        stage=extra["stage"],
        metrics=tuple(Metric(**row) for row in metrics.to_pylist()),
        views=tuple(ViewScore(**row) for row in read_table(folder / "views.parquet", SCORES)[0].to_pylist()),
        curve=tuple((row["iteration"], row["psnr"]) for row in curve.to_pylist()),
        pictures={p.name.removesuffix(".png"): read_png(p) for p in paths},
    )


def measurements(value: Evaluation) -> dict[str, Any]:
    """None."""
    return {}
