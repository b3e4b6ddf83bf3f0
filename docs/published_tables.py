"""The paper's tables, from the Parquet files that ``genre table`` wrote into ``docs/results/data``."""

from __future__ import annotations

from dataclasses import replace

from docs.result_tables import DATA, short_log
from flows.paper_tables.columns import Column, read_metric
from flows.paper_tables.layouts import Layout, get_layout
from flows.paper_tables.page import prefer_papers_quantities, render_extra_columns, render_papers_columns
from flows.paper_tables.parquet import read_cells

DATASETS = ("pandaset", "synthetic")
"""Names in the files, in the order of the page."""
_COLORS_FITTED = Column(
    "cc_psnr", "PSNR held out, colours fitted, dB", read_metric("interpolation/cc_psnr"), 2, more_is_better=True
)
_COMPARED_WITHOUT_EXPOSURE = (1, 2)
"""Tables in which some methods are judged with gains of exposure, and others without."""


def published_table(number: int) -> str:
    """A table of the paper on each dataset that it was measured on, measured / the paper's.

    Args:
        number: of the table, 1 to 5.
    """
    parts = []
    for dataset in DATASETS:
        cells, missing, facts = read_cells(DATA / f"table{number}_{dataset}.parquet")
        layout = prefer_papers_quantities(_published_layout(number), cells)
        measured_on = dict.fromkeys(short_log({"log": cell.log, "chunk": cell.chunk}) for cell in cells)
        title = f"### Table {number} on {', '.join(measured_on)}"
        lines = [title, "", *render_papers_columns(layout, cells, missing), ""]
        # Where nothing was measured beside the paper's columns, there is no second table.
        extra = [line for line in render_extra_columns(layout, cells) if line]
        if extra:
            lines += [extra[0], "", *extra[1:], ""]
        lines.append(f"Measured on {facts['machine']} at commit `{facts['commit'][:12]}` by {facts['command']}.")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _published_layout(number: int) -> Layout:
    layout = get_layout(number)
    # The notes on methods, which say this, are printed by `genre table` alone.
    if number in _COMPARED_WITHOUT_EXPOSURE:
        return replace(layout, extra_columns=(_COLORS_FITTED, *layout.extra_columns))
    return layout
