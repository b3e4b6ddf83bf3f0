"""Tables that a training adds to as it goes: its learning curve and its scores on validation logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from storage.codecs.tables import column, read_table, schema, write_table
from storage.files import make_folders, sync

LEARNING = schema(
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
VALIDATION = schema(
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
FIXING = schema(
    "fixing_curve/1",
    [
        column("step", pa.int64(), "weight updates before this one"),
        column("loss", pa.float64(), "of this update's crops"),
        column("seconds", pa.float64(), "wall time, a mean over the updates between two checkpoints"),
    ],
)
FIXING_SCORES = schema(
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


def write_rows(path: Path, declared: pa.Schema, rows: Sequence[Mapping[str, Any]]) -> None:
    """The whole table anew, complete or not at all."""
    make_folders(path.parent)
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.unlink(missing_ok=True)
    write_table(temporary, declared, {name: [row[name] for row in rows] for name in declared.names})
    sync(temporary)
    temporary.replace(path)


def read_rows(path: Path, declared: pa.Schema) -> list[dict[str, Any]]:
    """The rows, none where there is no file. Raises ``ArtifactCorruptError``."""
    if not path.is_file():
        return []
    return read_table(path, declared)[0].to_pylist()
