"""RolloutScores ↔ ``metrics.parquet``, ``views.parquet`` and ``features.parquet``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from genre_tasks.errors import ArtifactCorruptError
from genre_tasks.metrics.results import Metric, ViewScore
from genre_tasks.rollout.rollout_scores import RolloutScores
from storage.codecs.evaluation import METRICS, VIEW_SCORES
from storage.codecs.tables import (
    REMEDY,
    check_array,
    column,
    read_records,
    read_table,
    schema,
    write_records,
    write_table,
)
from storage.codecs.view_columns import FRAME

FEATURES = schema("features/1", [FRAME, column("features", pa.list_(pa.float32()), "pooled features of an image")])


def write(folder: Path, value: RolloutScores) -> None:
    """Writes the tables.

    Args:
        folder: an empty folder.
        value: the scores, on any device.

    Raises:
        ConfigError: the features have another dtype or shape.
        NonFiniteError: a feature is NaN or infinite.
    """
    write_records(folder / "metrics.parquet", METRICS, value.metrics)
    write_records(folder / "views.parquet", VIEW_SCORES, value.views)
    frames = value.features.frames
    features = check_array(value.features.features.cpu().numpy(), "features", np.float32, (len(frames), None))
    write_table(
        folder / "features.parquet",
        FEATURES,
        {"frame": list(frames), "features": [list(row) for row in features]},
        # Stated in the metadata, because a table without rows does not tell the length of a feature.
        {"dimensions": str(features.shape[1])},
    )


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> RolloutScores:
    """Reads scores.

    Args:
        folder: the folder that :func:`write` filled.
        measurements: not used: scores are all payload.

    Returns:
        The scores, features on the CPU.

    Raises:
        ArtifactCorruptError: a table is damaged.
    """
    import torch

    from genre_tasks.metrics.scoring import FeatureSet

    path = folder / "features.parquet"
    table, extra = read_table(path, FEATURES)
    frames = tuple(table.column("frame").to_pylist())
    values = table.column("features").combine_chunks().flatten().to_numpy(zero_copy_only=False)
    dimensions = int(extra.get("dimensions", -1))
    if len(values) != len(frames) * dimensions:
        raise ArtifactCorruptError("The features have several lengths", remedy=REMEDY, file=path)
    features = torch.from_numpy(np.array(values, np.float32).reshape(len(frames), dimensions))
    return RolloutScores(
        metrics=read_records(folder / "metrics.parquet", METRICS, Metric),
        views=read_records(folder / "views.parquet", VIEW_SCORES, ViewScore),
        features=FeatureSet(features, frames),
    )


def measurements(value: RolloutScores) -> dict[str, Any]:
    """Selects no measurements: scores are all payload.

    Returns:
        An empty dictionary.
    """
    return {}
