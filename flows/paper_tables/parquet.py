"""A table's Parquet file: every cell, with the paper's numbers of its row."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from flows.paper_tables.columns import MeasuredCell
from flows.paper_tables.layouts import Layout, Row
from flows.paper_tables.published_numbers import PAPER
from storage.codecs.tables import column, read_table, schema, write_table

CELLS = schema(
    "paper_table/1",
    [
        column("table", pa.int64(), "of the paper"),
        column("method", pa.string(), "the row"),
        column("end", pa.string(), "the stage whose scene or images are the result: gnet, enet or fnet"),
        column("settings", pa.string(), "JSON: the method's section.key=value"),
        column("note", pa.string(), "what the method leaves out, and what it ran with"),
        column("log", pa.string(), "URI; empty where nothing was measured"),
        column("chunk", pa.int64(), "of the log", nullable=True),
        column("seconds", pa.string(), "JSON: wall seconds by stage"),
        column("cpu_seconds", pa.string(), "JSON: CPU seconds by stage"),
        column("gaussians", pa.int64(), "of the scene", nullable=True),
        column("fixed", pa.int64(), "novel views that were fixed", nullable=True),
        column("metrics", pa.string(), "JSON: by name, as in an evaluation; …/n images, …/low and …/high of 95 %"),
        column("not_measured", pa.string(), "why, where nothing was measured"),
        column("paper_row", pa.string(), "the row's name in the paper; empty where it has none"),
        column("paper", pa.string(), "JSON: the paper's numbers of that row, on its data and features"),
    ],
)


def write_cells(
    path: Path,
    layout: Layout,
    cells: Sequence[MeasuredCell],
    missing: Mapping[str, str],
    facts: Mapping[str, str],
) -> None:
    """Writes a line for each cell, and one for each method without any.

    Args:
        path: the Parquet file to write.
        layout: the table.
        cells: what was measured.
        missing: label of a row → why it was not measured.
        facts: machine, commit and the like, for the file's metadata.
    """
    # A method without a cell has a line too, so that the reason for its absence is kept.
    lines: list[tuple[Row, MeasuredCell | None]] = []
    for row in layout.rows:
        measured: list[MeasuredCell | None] = [c for c in cells if c.method == row.label]
        lines += [(row, cell) for cell in measured or [None]]
    columns = {
        "table": [layout.number for _ in lines],
        "method": [r.label for r, _ in lines],
        "end": [r.method.end for r, _ in lines],
        "settings": [json.dumps(r.method.settings, ensure_ascii=False) for r, _ in lines],
        "note": [r.method.note for r, _ in lines],
        "log": ["" if c is None else c.log for _, c in lines],
        # Null and not -1, which a mean over the column would take in.
        "chunk": [None if c is None else c.chunk for _, c in lines],
        "seconds": [_to_json({} if c is None else c.seconds) for _, c in lines],
        "cpu_seconds": [_to_json({} if c is None else c.cpu_seconds) for _, c in lines],
        "gaussians": [None if c is None else c.gaussians for _, c in lines],
        "fixed": [None if c is None else c.fixed_views for _, c in lines],
        "metrics": [_to_json({} if c is None else c.metrics) for _, c in lines],
        "not_measured": [missing.get(r.label, "") if c is None else "" for r, c in lines],
        "paper_row": [r.paper for r, _ in lines],
        "paper": [_to_json(PAPER[layout.number].rows.get(r.paper, {})) for r, _ in lines],
    }
    write_table(path, CELLS, columns, facts)


def read_cells(path: Path) -> tuple[list[MeasuredCell], dict[str, str], dict[str, str]]:
    """Reads what :func:`write_cells` wrote.

    Args:
        path: the Parquet file.

    Returns:
        (measured cells, label of a row → why it was not measured, facts).

    Raises:
        ArtifactCorruptError: the file is missing or damaged.
    """
    table, facts = read_table(path, CELLS)
    cells = []
    missing = {}
    for line in table.to_pylist():
        if line["log"]:
            cells.append(_to_cell(line))
        # A row that was neither measured nor found wanting has no reason.
        elif line["not_measured"]:
            missing[line["method"]] = line["not_measured"]
    return cells, missing, facts


def _to_cell(line: Mapping[str, Any]) -> MeasuredCell:
    return MeasuredCell(
        method=line["method"],
        log=line["log"],
        chunk=line["chunk"],
        seconds=_from_json(line["seconds"]),
        cpu_seconds=_from_json(line["cpu_seconds"]),
        metrics=_from_json(line["metrics"]),
        gaussians=line["gaussians"],
        fixed_views=line["fixed"],
    )


def _from_json(text: str) -> dict[str, float]:
    return {k: math.nan if v is None else v for k, v in json.loads(text).items()}


def _to_json(values: Mapping[str, float]) -> str:
    # JSON has no NaN: what was not counted becomes null.
    return json.dumps({k: v if v == v else None for k, v in values.items()}, sort_keys=True)
