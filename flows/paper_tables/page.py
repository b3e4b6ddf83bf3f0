"""A table as Markdown: measured / paper in every cell that the paper has, and what keeps the two from comparing."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from flows.paper_tables.layouts import Cell, Column, Layout, Row
from flows.paper_tables.methods import PER_SCENE
from flows.paper_tables.published_numbers import PAPER
from genre_tasks.atomic_path import atomic_path
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import InputError
from storage.files import write_file

PUBLISHED_ITERATIONS = 30_000
KERNEL = (
    "the paper's distances are FID, on features of InceptionV3; measured are kernel distances (unbiased at any number "
    "of images) on features of EfficientNet-Lite0: they may be compared in their order alone, not in their size. FID "
    "and LPIPS are not measured: weights of neither ship with this project. Given by path (`--set "
    "evaluate.inception=PATH`, `--set evaluate.lpips=PATH`), FID takes these columns"
)
FID = "FID is biased by the number of images, which the paper does not state and which is a chunk's here"


def page(
    layout: Layout,
    cells: Sequence[Cell],
    missing: Mapping[str, str],
    facts: Sequence[str],
    apart: Sequence[str],
    dataset: str,
) -> str:
    """Title, the table, what else was measured, notes on methods, facts, and ``apart``: what is not comparable.

    ``missing``: a method's name → why it was not measured.
    """
    paper = PAPER[layout.number]
    layout = with_the_papers_own(layout, cells)
    head = [
        f"## Table {layout.number} on {dataset}: {paper.caption}",
        "",
        "measured / the paper's. " + _ordered(layout),
        "",
    ]
    return "\n".join(
        [
            *head,
            *_table(layout, layout.columns, cells, missing),
            "",
            *layout.said,
            *([""] if layout.said else []),
            *_beside(layout, cells),
            *_notes(layout, missing),
            "Not comparable with the paper's numbers:",
            "",
            *(f"* {text}" for text in apart),
            "",
            "Measured on:",
            "",
            *facts,
            "",
        ]
    )


def with_the_papers_own(layout: Layout, cells: Sequence[Cell]) -> Layout:
    """The layout with FID in the place of the kernel distance where it was measured, and that beside it."""
    own: list[Column] = []
    beside: list[Column] = []
    for column in layout.columns:
        if column.proper is None or not any(math.isfinite(column.proper(c)) for c in cells):
            own.append(column)
            continue
        own.append(Column(column.paper, column.paper_label, column.proper, 2, column.paper))
        beside.append(replace(column, paper="", paper_label="", proper=None))
    return replace(layout, columns=tuple(own), beside=(*beside, *layout.beside))


def differences_from_the_paper(layout: Layout, config: PipelineConfig, dataset: str, chunks: int) -> list[str]:
    """What keeps the measured numbers from being compared with the paper's, a sentence each."""
    size = f"{config.ingest.width_px}×{config.ingest.height_px}"
    over = f"{chunks} chunk{'s' * (chunks > 1)} of {'PandaSet' if dataset == 'pandaset' else dataset}"
    out = [f"the paper's are means over ten test sequences of PandaSet, these are of {over}"]
    if (config.ingest.width_px, config.ingest.height_px) != (1920, 1080):
        out.append(f"the paper's images are 1920×1080 (its fixer is trained at 1280×720), these {size}")
    if any(c.proper is not None for c in layout.columns):
        out.append(KERNEL if config.evaluate.inception is None else FID)
    per_scene = config.gnet.per_scene.iterations
    if per_scene != PUBLISHED_ITERATIONS and any(
        s == f"gnet.method={m}" for r in layout.rows for s in r.method.settings for m in PER_SCENE
    ):
        short = f"per-scene methods had {per_scene} iterations, of {PUBLISHED_ITERATIONS} as published"
        out.append(f"{short} (all of their schedules scaled): how far longer ones come was not measured")
    if config.fnet.model == "small" and any(r.method.end in ("enet", "fnet") for r in layout.rows):
        out.append("the paper's fixer is SD-Turbo with adapters, this one a small network of the same classes")
    if any(c.paper in ("minutes", "s_per_frame", "total") for c in layout.columns):
        out.append("the paper's times are of its GPU, these of the machine below")
    return out


def put_into(file: Path, number: int, dataset: str, text: str) -> None:
    """Writes ``text`` as the section of table ``number`` on ``dataset``, of a page that holds several; others stay.

    Sections are in the order of the tables, those of one table in that of the datasets' names.

    Raises ``InputError`` for a page whose marks do not fit.
    """
    begin, end = f"<!-- genre table {number} on {dataset} -->", f"<!-- end of table {number} on {dataset} -->"
    try:
        old = file.read_text(encoding="utf-8") if file.exists() else PREFACE
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"the page cannot be read: {error}", remedy="Check --into.", file=file) from error
    section = f"{begin}\n\n{text.strip()}\n\n{end}"
    if begin in old or end in old:
        if not (old.count(begin) == old.count(end) == 1 and old.index(begin) < old.index(end)):
            raise InputError(
                f"the page does not hold one section between '{begin}' and '{end}'",
                remedy="Mend its marks, or remove the page.",
                file=file,
            )
        new = old[: old.index(begin)] + section + old[old.index(end) + len(end) :]
    else:
        found = re.finditer(r"<!-- genre table (\d) on (\S+) -->", old)
        at = next((m.start() for m in found if (int(m[1]), m[2]) > (number, dataset)), len(old))
        new = old[:at].rstrip("\n") + f"\n\n{section}\n\n" + old[at:]
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(file) as part:
        write_file(part, (new.rstrip("\n") + "\n").encode())


PREFACE = (
    "# The paper's tables, measured here\n\n"
    "Each section is written by the command that it states, `genre table N … --into FILE`.\n"
)


def mean_of(column: Column, cells: Sequence[Cell]) -> float:
    """Over the places of a method; NaN where one of them has none."""
    values = [column.read(c) for c in cells]
    return math.fsum(values) / len(values) if values else math.nan


def _table(
    layout: Layout, columns: Sequence[Column], cells: Sequence[Cell], missing: Mapping[str, str]
) -> Iterator[str]:
    means = {(r.label, c.key): mean_of(c, _of(r, cells)) for r in layout.rows for c in columns}
    printed = PAPER[layout.number].rows
    yield "| method | " + " | ".join(_header(c) for c in columns) + " |"
    yield "|---" * (1 + len(columns)) + "|"
    for row in layout.rows:
        values = []
        for c in columns:
            best = _best([means[r.label, c.key] for r in layout.rows], c)
            own = means[row.label, c.key]
            text = "not measured" if row.label in missing else _number(own, c.digits) or "–"
            text = f"**{text}**" if own == best else text
            theirs = printed.get(row.paper, {}).get(c.paper, math.nan) if c.paper else math.nan
            values.append(text + (f" / {_plain(theirs)}" if math.isfinite(theirs) else ""))
        yield f"| {row.label} | " + " | ".join(values) + " |"


def _beside(layout: Layout, cells: Sequence[Cell]) -> Iterator[str]:
    """What the paper's table does not have, where it could be measured."""
    columns = [c for c in layout.beside if any(math.isfinite(mean_of(c, _of(r, cells))) for r in layout.rows)]
    if not columns:
        return
    yield "Measured beside it" + (
        " (PSNR and perceptual distance at a shift: against the truth there, on logs that have one):"
        if any(c.key.startswith("perceptual_") for c in columns)
        else ":"
    )
    yield ""
    yield "| method | " + " | ".join(c.label for c in columns) + " |"
    yield "|---" * (1 + len(columns)) + "|"
    for row in layout.rows:
        own = _of(row, cells)
        if own:
            yield f"| {row.label} | " + " | ".join(_number(mean_of(c, own), c.digits) for c in columns) + " |"
    yield ""


def _notes(layout: Layout, missing: Mapping[str, str]) -> Iterator[str]:
    lines = []
    for row in layout.rows:
        why = f"Not measured: {missing[row.label]}" if row.label in missing else ""
        text = " ".join(part for part in (row.method.note, why) if part)
        lines += [f"* {row.label}: {text}"] if text else []
    if lines:
        yield from lines
        yield ""


def _of(row: Row, cells: Sequence[Cell]) -> list[Cell]:
    return [c for c in cells if c.method == row.label]


def _header(column: Column) -> str:
    return column.label if not column.paper_label else f"{column.label} / {column.paper_label}"


def _ordered(layout: Layout) -> str:
    """What is better, and what bold means."""
    more = [c.label.partition(",")[0] for c in layout.columns if c.more_is_better]
    said = f"More is better in {' and '.join(more)}, less in the others. " if more else "Less is better. "
    return said + "**Bold**: the best measured."


def _best(values: Sequence[float], column: Column) -> float:
    finite = [v for v in values if math.isfinite(v)]
    return (max if column.more_is_better else min)(finite) if len(finite) > 1 else math.nan


def _number(value: float, digits: int) -> str:
    return f"{value:,.{digits}f}" if math.isfinite(value) else ""


def _plain(value: float) -> str:
    return f"{value:.2f}" if value >= 1 else f"{value:.3f}"
