"""A sweep's Parquet files: every cell, and a line for each setting."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from flows.cost_sweep.summary import COSTS, MEASURES, Measure, SettingSummary, Spread
from genre_tasks.bounded_parquet import FOR_ROWS
from genre_tasks.errors import ArtifactCorruptError
from storage.codecs.tables import REMEDY, column, read_table, schema, write_table

# The order is that of the columns: changing it needs a new version of the schema.
_MEASURES = (*COSTS, *MEASURES)


def _value_columns(measure: Measure) -> tuple[str, str]:
    """Names the columns of a measure's average and its standard deviation."""
    return f"{measure.name}_{measure.average}", f"{measure.name}_sd"


def _gain_columns(measure: Measure) -> tuple[str, str]:
    return f"{measure.name}_gain", f"{measure.name}_gain_sd"


def _measure_columns(measure: Measure) -> list[Any]:
    better = "more" if measure.more_is_better else "less"
    value, value_sd = _value_columns(measure)
    gain, gain_sd = _gain_columns(measure)
    gain_note = "over the preset in the same place with the same seed; positive is better"
    notes = {
        value: f"{measure.label}, {measure.average} over seeds: {better} is better",
        value_sd: "over seeds, pooled over places",
        gain: gain_note,
        gain_sd: "over seeds, pooled over places",
    }
    return [column(name, pa.float64(), note, nullable=True) for name, note in notes.items()]


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
        *(c for measure in _MEASURES for c in _measure_columns(measure)),
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
_PLAIN_CELL_COLUMNS = ("setting", "log", "chunk", "seed", "peak_mib", "gaussians", "images")
_JSON_CELL_COLUMNS = ("changes", "seconds", "cpu_seconds", "metrics")


def write_settings(path: Path, summaries: Sequence[SettingSummary], facts: Mapping[str, str]) -> None:
    """Writes a line for each setting.

    Args:
        path: the Parquet file to write.
        summaries: the settings.
        facts: machine, commit and the like, for the file's metadata.
    """
    columns: dict[str, Any] = {
        "knob": [x.knob for x in summaries],
        "value": [x.value for x in summaries],
        "n": [x.n for x in summaries],
        # JSON and not nested columns: each setting has other keys.
        "changes": [json.dumps(x.changes) for x in summaries],
        "end": [x.end for x in summaries],
        "threads": [x.threads for x in summaries],
        "images": [x.source_images for x in summaries],
        "stage_seconds": [json.dumps(x.stage_seconds) for x in summaries],
        "on_front": [",".join(x.on_front) for x in summaries],
    }
    for m in _MEASURES:
        columns |= _spread_columns(_value_columns(m), [x.values[m.name] for x in summaries])
        columns |= _spread_columns(_gain_columns(m), [x.gains[m.name] for x in summaries])
    write_table(path, LINES, columns, facts)


def _spread_columns(names: tuple[str, str], spreads: Sequence[Spread]) -> dict[str, list[float | None]]:
    average, sd = names
    return {average: [_null_if_nan(s.average) for s in spreads], sd: [_null_if_nan(s.sd) for s in spreads]}


def read_settings(path: Path) -> tuple[list[SettingSummary], dict[str, str]]:
    """Reads what :func:`write_settings` wrote.

    Returns:
        The settings, whose ``images_at_3m`` are NaN as the file does not hold them, and the strings of its metadata.

    Raises:
        ArtifactCorruptError: the file is no such table.
    """
    table, facts = read_table(path, LINES, FOR_ROWS)
    try:
        return [_summary(row) for row in table.to_pylist()], facts
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ArtifactCorruptError(f"A setting does not decode ({error})", remedy=REMEDY, file=path) from error


def _summary(row: Mapping[str, Any]) -> SettingSummary:
    return SettingSummary(
        knob=row["knob"],
        value=row["value"],
        setting=f"{row['knob']}={row['value']}" if row["value"] else row["knob"],
        n=row["n"],
        values={m.name: _read_spread(row, _value_columns(m)) for m in _MEASURES},
        gains={m.name: _read_spread(row, _gain_columns(m)) for m in _MEASURES},
        stage_seconds={str(stage): float(seconds) for stage, seconds in json.loads(row["stage_seconds"]).items()},
        # The file has no such column, and zero would be a claim.
        images_at_3m=math.nan,
        changes=tuple(str(change) for change in json.loads(row["changes"])),
        end=row["end"],
        threads=row["threads"],
        source_images=row["images"],
        # Splitting an empty string gives one empty name.
        on_front=tuple(m for m in row["on_front"].split(",") if m),
    )


def _read_spread(row: Mapping[str, Any], names: tuple[str, str]) -> Spread:
    average, sd = names
    return Spread(_nan_if_null(row[average]), _nan_if_null(row[sd]))


def write_cells(path: Path, rows: Sequence[Mapping[str, Any]], facts: Mapping[str, str]) -> None:
    """Writes every cell.

    Args:
        path: the Parquet file to write.
        rows: see :func:`flows.cost_sweep.cell.run_cell`.
        facts: machine, commit and the like, for the file's metadata.
    """
    columns = {name: [row[name] for row in rows] for name in _PLAIN_CELL_COLUMNS}
    columns |= {name: [json.dumps(row[name], sort_keys=True) for row in rows] for name in _JSON_CELL_COLUMNS}
    write_table(path, CELLS, {f.name: columns[f.name] for f in CELLS}, facts)


def _nan_if_null(value: float | None) -> float:
    return math.nan if value is None else value


def _null_if_nan(value: float) -> float | None:
    # Null and not NaN: readers of Parquet leave nulls out of averages, and let a NaN spoil them.
    return None if math.isnan(value) else value
