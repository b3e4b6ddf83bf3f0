"""Plan of effects ↔ ``effects.parquet``, a row an effect; ``gains.parquet`` and ``own/CAMERA.png`` of those applied."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from genre_tasks.effects.types import Decision, EffectsPlan, Fitted
from storage.codecs.png import read_png, write_png
from storage.codecs.tables import column, read_table, schema, write_table

_CHANNELS = ("red", "green", "blue")
EFFECTS = schema(
    "effects/1",
    [
        column("name", pa.string(), "the effect"),
        column("property", pa.string(), "what of the log decides"),
        column("value", pa.float64(), "in the unit; NaN where the log does not tell or nothing was measured"),
        column("unit", pa.string(), "of value and threshold"),
        column("threshold", pa.float64(), "called for above it; NaN where nothing was measured"),
        column("setting", pa.string(), "auto, on or off: what was configured"),
        column("choice", pa.string(), "on, off, or mark: told, not modelled"),
        column("reason", pa.string(), "why"),
        column("cost", pa.string(), "what enabling costs"),
    ],
)

GAINS = schema(
    "gains/1",
    [
        column("camera", pa.string(), "name"),
        column("frame", pa.int64(), "frame of the log"),
        *(column(c, pa.float64(), "natural logarithm of the image's gain in linear light") for c in _CHANNELS),
    ],
)


def write(folder: Path, value: EffectsPlan) -> None:
    """Write the table, the gains and a picture of the vehicle itself a camera: white where it is."""
    rows = {name: [getattr(d, name) for d in value.decisions] for name in EFFECTS.names}
    write_table(folder / "effects.parquet", EFFECTS, rows)
    images, gains = list(value.fitted.gains), np.array(list(value.fitted.gains.values())).reshape(-1, 3)
    which = {"camera": [camera for camera, _ in images], "frame": [frame for _, frame in images]}
    write_table(folder / "gains.parquet", GAINS, which | {c: gains[:, k] for k, c in enumerate(_CHANNELS)})
    if value.fitted.own:
        (folder / "own").mkdir()
    for camera, own in value.fitted.own.items():
        write_png(folder / "own" / f"{camera}.png", np.repeat(np.uint8(255) * own[..., None], 3, 2))


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> EffectsPlan:
    """The plan, in its order."""
    table, _ = read_table(folder / "effects.parquet", EFFECTS)
    rows = read_table(folder / "gains.parquet", GAINS)[0].to_pylist()
    gains = {(row["camera"], row["frame"]): (row["red"], row["green"], row["blue"]) for row in rows}
    own = {path.stem: read_png(path)[..., 0] > 0 for path in sorted((folder / "own").glob("*.png"))}
    return EffectsPlan(tuple(Decision(**row) for row in table.to_pylist()), Fitted(gains, own))


def measurements(value: EffectsPlan) -> dict[str, Any]:
    """Nothing: all of it follows from the log."""
    return {}
