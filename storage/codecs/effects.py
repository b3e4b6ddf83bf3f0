"""Plan of effects ↔ ``effects.parquet``, a row an effect."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from genre_tasks.effects.types import Decision, EffectsPlan
from storage.codecs.tables import column, read_table, schema, write_table

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


def write(folder: Path, value: EffectsPlan) -> None:
    """Write the table."""
    rows = {name: [getattr(d, name) for d in value.decisions] for name in EFFECTS.names}
    write_table(folder / "effects.parquet", EFFECTS, rows)


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> EffectsPlan:
    """The plan, in its order."""
    table, _ = read_table(folder / "effects.parquet", EFFECTS)
    return EffectsPlan(tuple(Decision(**row) for row in table.to_pylist()))


def measurements(value: EffectsPlan) -> dict[str, Any]:
    """Nothing: all of it follows from the log."""
    return {}
