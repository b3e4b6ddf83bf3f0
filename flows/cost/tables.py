"""A sweep's Parquet: every cell, and a line for each setting."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from flows.cost.summary import COSTS, MEASURES, Line
from storage.codecs.tables import column, schema, write_table

_MEASURES = (*COSTS, *MEASURES)
LINES = schema(
    "cost/1",
    [
        column("knob", pa.string(), "what is turned; preset: nothing"),
        column("value", pa.string(), "to what"),
        column("n", pa.int64(), "cells: logs × chunks × seeds"),
        column("on_front", pa.string(), "the measures in which no setting is as good in less time, with commas"),
        *(
            column(f"{m.name}_{part}", pa.float64(), note, nullable=True)
            for m in _MEASURES
            for part, note in (
                ("mean", f"{m.label}: {'more' if m.more_is_better else 'less'} is better"),
                ("sd", "over seeds, pooled over places"),
                ("gain", "over the preset in the same place with the same seed; positive is better"),
                ("gain_sd", "over seeds, pooled over places"),
            )
        ),
    ],
)
CELLS = schema(
    "cost_cells/1",
    [
        column("setting", pa.string(), "knob=value"),
        column("log", pa.string(), "URI"),
        column("chunk", pa.int64(), "of the log"),
        column("seed", pa.int64(), "of the order of views and of the fixer's noise"),
        column("seconds", pa.string(), "JSON: wall seconds by stage"),
        column("cpu_seconds", pa.string(), "JSON: CPU seconds by stage; null where the stage was made without"),
        column("peak_mib", pa.float64(), "of the process while a stage ran, MiB"),
        column("gaussians", pa.int64(), "of the scene"),
        column("metrics", pa.string(), "JSON: by name, as in an evaluation"),
    ],
)


def write_lines(path: Path, lines: Sequence[Line], extra: Mapping[str, str]) -> None:
    """``extra``: machine, commit and the like, into the file's metadata."""
    columns: dict[str, Any] = {"knob": [x.knob for x in lines], "value": [x.value for x in lines]}
    columns |= {"n": [x.n for x in lines], "on_front": [",".join(x.on_front) for x in lines]}
    for m in _MEASURES:
        for part, spreads in (("", [x.values[m.name] for x in lines]), ("gain", [x.gains[m.name] for x in lines])):
            columns[f"{m.name}_{part or 'mean'}"] = [_number(s.mean) for s in spreads]
            columns[f"{m.name}_{part}{'_' * bool(part)}sd"] = [_number(s.sd) for s in spreads]
    write_table(path, LINES, columns, extra)


def write_cells(path: Path, rows: Sequence[Mapping[str, Any]], extra: Mapping[str, str]) -> None:
    """As :func:`write_lines`, of the rows of :func:`flows.cost.cell.run_cell`."""
    plain = ("setting", "log", "chunk", "seed", "peak_mib", "gaussians")
    columns = {name: [row[name] for row in rows] for name in plain}
    columns |= {k: [json.dumps(row[k], sort_keys=True) for row in rows] for k in ("seconds", "cpu_seconds", "metrics")}
    write_table(path, CELLS, {f.name: columns[f.name] for f in CELLS}, extra)


def _number(value: float) -> float | None:
    return None if value != value else value
