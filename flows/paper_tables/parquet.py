"""A table's Parquet: every cell, with the paper's numbers of its row."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow as pa

from flows.paper_tables.layouts import Cell, Layout
from flows.paper_tables.published_numbers import PAPER
from storage.codecs.tables import column, schema, write_table

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
    path: Path, layout: Layout, cells: Sequence[Cell], missing: Mapping[str, str], extra: Mapping[str, str]
) -> None:
    """A row for each cell, and one for each method without any (``missing``: its name → why)."""
    rows = []
    for row in layout.rows:
        own: list[Cell | None] = [c for c in cells if c.method == row.label]
        for cell in own or [None]:
            rows.append((row, cell))
    columns = {
        "table": [layout.number for _ in rows],
        "method": [r.label for r, _ in rows],
        "end": [r.method.end for r, _ in rows],
        "settings": [json.dumps(r.method.settings, ensure_ascii=False) for r, _ in rows],
        "note": [r.method.note for r, _ in rows],
        "log": ["" if c is None else c.log for _, c in rows],
        "chunk": [None if c is None else c.chunk for _, c in rows],
        "seconds": [_json({} if c is None else c.seconds) for _, c in rows],
        "cpu_seconds": [_json({} if c is None else c.cpu_seconds) for _, c in rows],
        "gaussians": [None if c is None else c.gaussians for _, c in rows],
        "fixed": [None if c is None else c.fixed for _, c in rows],
        "metrics": [_json({} if c is None else c.metrics) for _, c in rows],
        "not_measured": [missing.get(r.label, "") if c is None else "" for r, c in rows],
        "paper_row": [r.paper for r, _ in rows],
        "paper": [_json(PAPER[layout.number].rows.get(r.paper, {})) for r, _ in rows],
    }
    write_table(path, CELLS, columns, extra)


def _json(values: Mapping[str, float]) -> str:
    """Numbers that are not finite become null."""
    return json.dumps({k: v if v == v else None for k, v in values.items()}, sort_keys=True)
