"""A sweep's Parquet: every cell, and a line for each setting."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from flows.cost_sweep.summary import COSTS, MEASURES, Line, Spread
from storage.codecs.tables import column, read_table, schema, write_table

_MEASURES = (*COSTS, *MEASURES)
LINES = schema(
    "cost/3",
    [
        column("knob", pa.string(), "what is turned; preset: nothing"),
        column("value", pa.string(), "to what"),
        column("n", pa.int64(), "cells: logs × chunks × seeds"),
        column("changes", pa.string(), "JSON: section.key=value over the preset"),
        column("end", pa.string(), "the stage whose scene is the result: gnet or enet"),
        column("threads", pa.int64(), "of the CPU; 0: all"),
        column("images", pa.float64(), "in a chunk, source views and held-out ones"),
        column("stage_seconds", pa.string(), "JSON: median wall seconds by stage"),
        column("on_front", pa.string(), "the measures in which no setting is as good in less time, with commas"),
        *(
            column(f"{m.name}_{part}", pa.float64(), note, nullable=True)
            for m in _MEASURES
            for part, note in (
                (m.middle, f"{m.label}, {m.middle} over seeds: {'more' if m.more_is_better else 'less'} is better"),
                ("sd", "over seeds, pooled over places"),
                ("gain", "over the preset in the same place with the same seed; positive is better"),
                ("gain_sd", "over seeds, pooled over places"),
            )
        ),
    ],
)
CELLS = schema(
    "cost_cells/2",
    [
        column("setting", pa.string(), "knob=value"),
        column("changes", pa.string(), "JSON: section.key=value over the preset"),
        column("log", pa.string(), "URI"),
        column("chunk", pa.int64(), "of the log"),
        column("seed", pa.int64(), "of the order of views and of the fixer's noise"),
        column("seconds", pa.string(), "JSON: wall seconds by stage"),
        column("cpu_seconds", pa.string(), "JSON: CPU seconds by stage; null where the stage was made without"),
        column("peak_mib", pa.float64(), "of the process while a stage ran, MiB"),
        column("gaussians", pa.int64(), "of the scene"),
        column("images", pa.int64(), "in the chunk, source views and held-out ones"),
        column("metrics", pa.string(), "JSON: by name, as in an evaluation"),
    ],
)


def write_lines(path: Path, lines: Sequence[Line], extra: Mapping[str, str]) -> None:
    """``extra``: machine, commit and the like, into the file's metadata."""
    columns: dict[str, Any] = {"knob": [x.knob for x in lines], "value": [x.value for x in lines]}
    columns |= {"n": [x.n for x in lines], "changes": [json.dumps(x.changes) for x in lines]}
    columns |= {"end": [x.end for x in lines], "threads": [x.threads for x in lines]}
    columns |= {"images": [x.source_images for x in lines]}
    columns |= {"stage_seconds": [json.dumps(x.stage_seconds) for x in lines]}
    columns |= {"on_front": [",".join(x.on_front) for x in lines]}
    for m in _MEASURES:
        for part, spreads in (("", [x.values[m.name] for x in lines]), ("gain", [x.gains[m.name] for x in lines])):
            columns[f"{m.name}_{part or m.middle}"] = [_number(s.middle) for s in spreads]
            columns[f"{m.name}_{part}{'_' * bool(part)}sd"] = [_number(s.sd) for s in spreads]
    write_table(path, LINES, columns, extra)


def read_lines(path: Path) -> tuple[list[Line], dict[str, str]]:
    """What :func:`write_lines` wrote, and the strings of its metadata. Distances' numbers of images are not in it.

    Raises ``ArtifactCorruptError`` for a file that is no such table.
    """
    table, extra = read_table(path, LINES)
    return [_line(row) for row in table.to_pylist()], extra


def _line(row: Mapping[str, Any]) -> Line:
    def spreads(part: str) -> dict[str, Spread]:
        return {
            m.name: Spread(
                _float(row[f"{m.name}_{part or m.middle}"]), _float(row[f"{m.name}_{part}{'_' * bool(part)}sd"])
            )
            for m in _MEASURES
        }

    name = row["knob"] if not row["value"] else f"{row['knob']}={row['value']}"
    return Line(
        row["knob"],
        row["value"],
        name,
        row["n"],
        spreads(""),
        spreads("gain"),
        json.loads(row["stage_seconds"]),
        math.nan,
        tuple(json.loads(row["changes"])),
        row["end"],
        row["threads"],
        row["images"],
        tuple(m for m in row["on_front"].split(",") if m),
    )


def write_cells(path: Path, rows: Sequence[Mapping[str, Any]], extra: Mapping[str, str]) -> None:
    """As :func:`write_lines`, of the rows of :func:`flows.cost_sweep.cell.run_cell`."""
    plain = ("setting", "log", "chunk", "seed", "peak_mib", "gaussians", "images")
    columns = {name: [row[name] for row in rows] for name in plain}
    columns |= {
        k: [json.dumps(row[k], sort_keys=True) for row in rows]
        for k in ("changes", "seconds", "cpu_seconds", "metrics")
    }
    write_table(path, CELLS, {f.name: columns[f.name] for f in CELLS}, extra)


def _float(value: float | None) -> float:
    return math.nan if value is None else value


def _number(value: float) -> float | None:
    return None if value != value else value
