"""Tables that a training adds to as it goes: its learning curve and its scores on validation logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from storage.codecs.tables import column, read_rows, schema, write_table
from storage.files import make_folders, sync

# Tables of trainings that were stopped are read on: names and notes of columns stay those of the first version.
LEARNING_CURVE = schema(
    "learning_curve/1",
    [
        column("step", pa.int64(), "weight updates before this one"),
        column("scene", pa.string(), "training scene"),
        column("iteration", pa.int64(), "the scene's iteration after this update's segment"),
        column("seen_loss", pa.float64(), "loss on views that the optimiser sees, at the segment's end"),
        column("judged_loss", pa.float64(), "loss on views that it does not see, at the segment's end"),
        column("gradient_norm", pa.float64(), "of the weights' gradient, before it is clipped"),
        column("seconds", pa.float64(), "wall time of this update"),
    ],
)
VALIDATION_SCORES = schema(
    "validation/1",
    [
        column("step", pa.int64(), "weight updates so far"),
        column("scene", pa.string(), "validation scene"),
        column("start_db", pa.float64(), "held-out PSNR where the optimisation begins"),
        column("adam_db", pa.float64(), "held-out PSNR after tuned Adam with the same views, loss and iterations"),
        column("learned_db", pa.float64(), "held-out PSNR after the network in training"),
        column("seconds", pa.float64(), "wall time of the network's run"),
    ],
)
FIXER_CURVE = schema(
    "fixing_curve/1",
    [
        column("step", pa.int64(), "weight updates before this one"),
        column("loss", pa.float64(), "of this update's crops"),
        column("seconds", pa.float64(), "wall time, a mean over the updates between two checkpoints"),
    ],
)
FIXER_SCORES = schema(
    "fixing_scores/1",
    [
        column("step", pa.int64(), "weight updates so far"),
        column("views", pa.int64(), "beside the path of validation streets"),
        column("psnr_render", pa.float64(), "dB against the truth, a mean over views"),
        column("psnr_fixed", pa.float64(), "the same of the fixed images"),
        column("perceptual_render", pa.float64(), "distance to the truth, a mean over views"),
        column("perceptual_fixed", pa.float64(), "the same of the fixed images"),
        column("psnr_identity", pa.float64(), "dB of the truth given as the render"),
    ],
)


def save_rows(path: Path, declared: pa.Schema, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes a table in place of the old one; at any moment the file is complete.

    Args:
        path: the file; its folder is made where it is missing.
        declared: the table's schema.
        rows: a value for each column, by name.
    """
    make_folders(path.parent)
    temporary = path.with_name(f".{path.name}.tmp")
    # Tables are written to new files only, and a killed training may have left this one.
    temporary.unlink(missing_ok=True)
    # All rows are written again: Parquet cannot be appended to, and a training has a few thousand.
    write_table(temporary, declared, {name: [row[name] for row in rows] for name in declared.names})
    # Without this a power cut after the rename could leave an empty file under the good name.
    sync(temporary)
    temporary.replace(path)


def load_rows(path: Path, declared: pa.Schema) -> list[dict[str, Any]]:
    """Reads a table that may not be there yet.

    Args:
        path: the file.
        declared: the table's schema.

    Returns:
        A dictionary for each row; none where there is no file.

    Raises:
        ArtifactCorruptError: the table is damaged.
    """
    return read_rows(path, declared) if path.is_file() else []
