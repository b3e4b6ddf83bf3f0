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
from storage.codecs.tables import (
    REMEDY,
    column,
    read_records,
    read_rows,
    read_table,
    schema,
    write_records,
    write_table,
)
from storage.codecs.view_columns import CAMERA_AND_FRAME, SHIFT

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
VIEW_SCORES = schema(
    "view_scores/1",
    [
        *CAMERA_AND_FRAME,
        SHIFT,
        column("psnr", pa.float64(), "dB"),
        column("ssim", pa.float64(), "at most 1"),
        column("perceptual", pa.float64(), "0 is equal"),
    ],
)
CURVE = schema(
    "curve/1",
    [column("iteration", pa.int64(), "iterations done"), column("psnr", pa.float64(), "dB, held-out frames")],
)
_PICTURE_NAME = re.compile(r"[A-Za-z0-9_+=-][A-Za-z0-9_.+=-]{0,180}")


def write(folder: Path, value: Evaluation) -> None:
    """Writes the tables and the pictures.

    Args:
        folder: an empty folder.
        value: the evaluation.

    Raises:
        ConfigError: a picture is no uint8 image [H, W, 3], or its name cannot be a file's name.
    """
    write_records(folder / "metrics.parquet", METRICS, value.metrics, {"stage": value.stage})
    write_records(folder / "views.parquet", VIEW_SCORES, value.views)
    # Doubles keep infinity and NaN, which JSON could not: identical images have an infinite PSNR.
    curve = {"iteration": [i for i, _ in value.curve], "psnr": [p for _, p in value.curve]}
    write_table(folder / "curve.parquet", CURVE, curve)
    if value.pictures:
        (folder / "pictures").mkdir()
    # Names come from cameras, which a log may call anything.
    for name, image in sorted(value.pictures.items()):
        if not _PICTURE_NAME.fullmatch(name):
            raise ConfigError(
                f"The picture's name {name!r} cannot be a file's name", remedy="Use letters, digits and _ . + = - only."
            )
        write_png(folder / "pictures" / f"{name}.png", image)


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> Evaluation:
    """Reads an evaluation.

    Args:
        folder: the folder that :func:`write` filled.
        measurements: not used: an evaluation is all payload.

    Returns:
        The evaluation, its pictures in the order of their names.

    Raises:
        ArtifactCorruptError: a table or a picture is damaged.
    """
    # The stage is a fact of the whole table, so it stands in the metadata and not in every row.
    metrics, extra = read_table(folder / "metrics.parquet", METRICS)
    if "stage" not in extra:
        raise ArtifactCorruptError("The stage is missing", remedy=REMEDY, file=folder / "metrics.parquet")
    # Without pictures there is no folder, which is no damage.
    pictures = folder / "pictures"
    paths = sorted(pictures.iterdir()) if pictures.is_dir() else []
    return Evaluation(
        stage=extra["stage"],
        metrics=tuple(Metric(**row) for row in metrics.to_pylist()),
        views=read_records(folder / "views.parquet", VIEW_SCORES, ViewScore),
        curve=tuple((row["iteration"], row["psnr"]) for row in read_rows(folder / "curve.parquet", CURVE)),
        pictures={p.name.removesuffix(".png"): read_png(p) for p in paths},
    )


def measurements(value: Evaluation) -> dict[str, Any]:
    """Selects no measurements: an evaluation is all payload.

    Returns:
        An empty dictionary.
    """
    return {}
