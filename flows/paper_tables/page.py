"""A table as Markdown: measured / paper in every cell that the paper has, and what keeps the two from comparing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from flows.experiments.stage_prediction import PER_SCENE_METHODS
from flows.paper_tables.columns import Column, MeasuredCell, mean_over_cells
from flows.paper_tables.layouts import Layout, Row
from flows.paper_tables.published_numbers import PAPER
from genre_tasks.config import PipelineConfig

PUBLISHED_ITERATIONS = 30_000
PUBLISHED_SIZE_PX = (1920, 1080)
KERNEL = (
    "the paper's distances are FID, on features of InceptionV3; measured are kernel distances (unbiased at any number "
    "of images) on features of EfficientNet-Lite0: they may be compared in their order alone, not in their size. FID "
    "is not measured: its weights do not ship with this project. Given by path (`--set evaluate.inception=PATH`), FID "
    "takes these columns; LPIPS is measured by `--set evaluate.lpips=vgg`"
)
FID = "FID is biased by the number of images, which the paper does not state and which is a chunk's here"


def render_page(
    layout: Layout,
    cells: Sequence[MeasuredCell],
    missing: Mapping[str, str],
    facts: Sequence[str],
    differences: Sequence[str],
    dataset: str,
) -> str:
    """Writes the section of one table.

    Args:
        layout: the table.
        cells: what was measured.
        missing: label of a row → why it was not measured.
        facts: Markdown lines that say what was measured, on which machine and at which commit.
        differences: what keeps the numbers from being compared with the paper's, a sentence each.
        dataset: of the logs.

    Returns:
        Markdown: title, the table, what else was measured, notes on methods, differences and facts.
    """
    layout = prefer_papers_quantities(layout, cells)
    lines = [
        f"## Table {layout.number} on {dataset}: {PAPER[layout.number].caption}",
        "",
        "measured / the paper's. " + _legend(layout),
        "",
        *render_papers_columns(layout, cells, missing),
        "",
        *layout.notes,
    ]
    if layout.notes:
        lines.append("")
    lines += [
        *render_extra_columns(layout, cells),
        *_method_notes(layout, missing),
        "Not comparable with the paper's numbers:",
        "",
        *(f"* {text}" for text in differences),
        "",
        "Measured on:",
        "",
        *facts,
        "",
    ]
    return "\n".join(lines)


def prefer_papers_quantities(layout: Layout, cells: Sequence[MeasuredCell]) -> Layout:
    """Puts FID in the place of the kernel distance where FID was measured.

    Args:
        layout: the table.
        cells: what was measured.

    Returns:
        The table; a kernel distance that FID replaced is among its extra columns.
    """
    columns: list[Column] = []
    replaced: list[Column] = []
    for column in layout.columns:
        read = column.read_papers_quantity
        # One row with FID is enough: the others then show a gap, as two quantities must not share a column.
        if read is None or not any(math.isfinite(read(c)) for c in cells):
            columns.append(column)
            continue
        columns.append(Column(column.paper, column.paper_label, read, 2, paper=column.paper))
        replaced.append(replace(column, paper="", paper_label="", read_papers_quantity=None))
    return replace(layout, columns=tuple(columns), extra_columns=(*replaced, *layout.extra_columns))


def list_differences(layout: Layout, config: PipelineConfig, dataset: str, chunks: int) -> list[str]:
    """Lists what keeps the measured numbers from being compared with the paper's.

    Args:
        layout: the table.
        config: the preset with protocol and settings, without any method's.
        dataset: of the logs.
        chunks: number of chunks that were measured.

    Returns:
        A sentence each, without full stop.
    """
    size = f"{config.ingest.width_px}×{config.ingest.height_px}"
    plural = "s" if chunks > 1 else ""
    over = f"{chunks} chunk{plural} of {'PandaSet' if dataset == 'pandaset' else dataset}"
    out = [f"the paper's are means over ten test sequences of PandaSet, these are of {over}"]
    if (config.ingest.width_px, config.ingest.height_px) != PUBLISHED_SIZE_PX:
        out.append(f"the paper's images are 1920×1080 (its fixer is trained at 1280×720), these {size}")
    if any(c.read_papers_quantity is not None for c in layout.columns):
        out.append(KERNEL if config.evaluate.inception is None else FID)
    # The preset shortens per-scene training, which a reader must know before comparing.
    iterations = config.gnet.per_scene.iterations
    if iterations != PUBLISHED_ITERATIONS and _has_per_scene_method(layout):
        # Shorter training favours the feed-forward methods, so the table has to say so.
        short = f"per-scene methods had {iterations} iterations, of {PUBLISHED_ITERATIONS} as published"
        out.append(f"{short} (all of their schedules scaled): how far longer ones come was not measured")
    if config.fnet.model == "small" and any(r.method.end in ("enet", "fnet") for r in layout.rows):
        out.append("the paper's fixer is SD-Turbo with adapters, this one a small network of the same classes")
    if any(c.paper in ("minutes", "s_per_frame", "total") for c in layout.columns):
        out.append("the paper's times are of its GPU, these of the machine below")
    return out


def _has_per_scene_method(layout: Layout) -> bool:
    per_scene = {f"gnet.method={m}" for m in PER_SCENE_METHODS}
    return any(per_scene.intersection(r.method.settings) for r in layout.rows)


def render_papers_columns(layout: Layout, cells: Sequence[MeasuredCell], missing: Mapping[str, str]) -> Iterator[str]:
    """Writes the lines of the table that the paper has too, the measured mean before the paper's number.

    Args:
        layout: the table.
        cells: what was measured.
        missing: label of a row → why it was not measured.
    """
    means = {(r.label, c.key): mean_over_cells(c, _cells_of(r, cells)) for r in layout.rows for c in layout.columns}
    best = {c.key: _best([means[r.label, c.key] for r in layout.rows], c) for c in layout.columns}
    printed = PAPER[layout.number].rows
    yield "| method | " + " | ".join(_heading(c) for c in layout.columns) + " |"
    yield "|---" * (1 + len(layout.columns)) + "|"
    for row in layout.rows:
        values = []
        for c in layout.columns:
            mean = means[row.label, c.key]
            text = "not measured" if row.label in missing else _format(mean, c.digits) or "–"
            # A best of NaN equals nothing, so that a single measured row is not printed in bold.
            if mean == best[c.key]:
                text = f"**{text}**"
            published = printed.get(row.paper, {}).get(c.paper, math.nan) if c.paper else math.nan
            values.append(text + (f" / {_format_published(published)}" if math.isfinite(published) else ""))
        yield f"| {row.label} | " + " | ".join(values) + " |"


def render_extra_columns(layout: Layout, cells: Sequence[MeasuredCell]) -> Iterator[str]:
    """Writes what the paper's table does not have, where it could be measured.

    Args:
        layout: the table.
        cells: what was measured.
    """
    columns = [
        c
        for c in layout.extra_columns
        if any(math.isfinite(mean_over_cells(c, _cells_of(r, cells))) for r in layout.rows)
    ]
    if not columns:
        return
    has_truth = any(c.key.startswith("perceptual_") for c in columns)
    note = " (PSNR and perceptual distance at a shift: against the truth there, on logs that have one)"
    yield f"Measured beside it{note if has_truth else ''}:"
    yield ""
    yield "| method | " + " | ".join(c.label for c in columns) + " |"
    yield "|---" * (1 + len(columns)) + "|"
    for row in layout.rows:
        measured = _cells_of(row, cells)
        # Rows without a measurement are explained in the notes already.
        if measured:
            values = [_format(mean_over_cells(c, measured), c.digits) for c in columns]
            yield f"| {row.label} | " + " | ".join(values) + " |"
    yield ""


def _method_notes(layout: Layout, missing: Mapping[str, str]) -> Iterator[str]:
    lines = []
    for row in layout.rows:
        why = f"Not measured: {missing[row.label]}" if row.label in missing else ""
        text = " ".join(part for part in (row.method.note, why) if part)
        if text:
            lines.append(f"* {row.label}: {text}")
    if lines:
        yield from lines
        yield ""


def _cells_of(row: Row, cells: Sequence[MeasuredCell]) -> list[MeasuredCell]:
    return [c for c in cells if c.method == row.label]


def _heading(column: Column) -> str:
    return column.label if not column.paper_label else f"{column.label} / {column.paper_label}"


def _legend(layout: Layout) -> str:
    """Says what is better, and what bold means."""
    more = [c.label.partition(",")[0] for c in layout.columns if c.more_is_better]
    direction = f"More is better in {' and '.join(more)}, less in the others. " if more else "Less is better. "
    return direction + "**Bold**: the best measured."


def _best(values: Sequence[float], column: Column) -> float:
    """Gives the best of the measured values; NaN where there is nothing to compare it with."""
    finite = [v for v in values if math.isfinite(v)]
    # The best of one is no statement.
    if len(finite) < 2:
        return math.nan
    return max(finite) if column.more_is_better else min(finite)


def _format(value: float, digits: int) -> str:
    # An empty cell and not "nan", which a reader could take for a failure of the method.
    return f"{value:,.{digits}f}" if math.isfinite(value) else ""


def _format_published(value: float) -> str:
    # The paper prints two decimals, and three of what is below one.
    return f"{value:.2f}" if value >= 1 else f"{value:.3f}"
