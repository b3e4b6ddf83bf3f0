"""The sweep as a flow: cell after cell, the stages of each from the store as far as they are there."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from flows.cost_sweep.cell import Cell, Sweep, measure_cold_start, read_logs_once, run_cell
from flows.cost_sweep.knobs import PRESET_ITSELF
from flows.cost_sweep.page import render_page
from flows.cost_sweep.parquet import write_cells, write_settings
from flows.cost_sweep.plot import draw_sweep
from flows.cost_sweep.request import SweepRequest
from flows.cost_sweep.summary import novel_view_measure, summarise_settings
from flows.experiments.result_files import machine_facts, write_text
from flows.experiments.stages import run_reported_stage
from flows.machine.calibration import measure_calibration_s
from flows.pipeline.progress import get_reporter
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import GenreError
from storage.codecs.png import write_png
from storage.opening import open_store


@flow(name="cost-of-accuracy", persist_result=False, validate_parameters=False)
def cost_of_accuracy(
    logs: list[str],
    preset: str = "small",
    store: str = "genre-store",
    chunks: list[int] | None = None,
    seeds: list[int] | None = None,
    knobs: list[str] | None = None,
    settings: list[str] | None = None,
    out: str = "cost",
) -> dict[str, Any]:
    """Turns each knob on each log with each seed, and writes a table, a picture and a page.

    Finished stages come from the store: killed at any point, it goes on where it was.

    Args:
        logs: URIs; ``pandaset:PATH/*`` stands for every sequence in a folder.
        preset: name of the preset.
        store: folder of the store.
        chunks: of each log; all if ``None``.
        seeds: of the order of views and the fixer's noise; three if ``None``.
        knobs: which knobs to turn; all if ``None``.
        settings: ``section.key=value`` over the preset, for every cell.
        out: folder to write into.

    Returns:
        ``cells``, their number; ``failed``, names of cells that are left out; ``files`` that were written.

    Raises:
        GenreError: a cell of the preset itself failed, so that nothing could be compared with it.
    """
    request = SweepRequest(Sweep(preset, tuple(settings or ()), store), logs, chunks, seeds, knobs)
    cells = request.cells()
    open_store(store).clean_temporaries()
    reporter = get_reporter()
    reporter.part_started("warming up")
    cold = measure_cold_start(request.sweep)
    fastest = measure_calibration_s()
    reporter.part_ended(f"{sum(cold.values()):.1f} s more than warm")
    reporter.part_started("reading the logs")
    read_logs_once(request.sweep, cells)
    reporter.part_ended("each once, before anything is timed")
    rows, failed = _run_cells(request.sweep, cells)
    # Calibrated before and after: what else runs on the machine seldom disturbs both.
    fastest = min(fastest, measure_calibration_s())
    speed = {"calibration_s": f"{fastest:.4f}", "cold_seconds": json.dumps(cold)}
    left_out = [f"{name}: {error}" for name, error in failed.items()]
    files = write_results(Path(out), request.sweep, rows, left_out, request.command, speed)
    return {"cells": len(rows), "failed": sorted(failed), "files": files}


def _run_cells(sweep: Sweep, cells: Sequence[Cell]) -> tuple[list[dict[str, Any]], dict[str, GenreError]]:
    """Gives the rows, and the errors of cells that failed, such as for lack of memory."""
    rows: list[dict[str, Any]] = []
    failed: dict[str, GenreError] = {}
    reporter = get_reporter()
    for k, cell in enumerate(cells):
        reporter.part_started(f"{k + 1}/{len(cells)} {cell.name}")
        try:
            row = cell_task(sweep, cell)
        except GenreError as error:
            if cell.setting.knob == PRESET_ITSELF:
                raise
            failed[cell.name] = error
            reporter.part_ended(f"left out: {error}")
            continue
        if row is None:
            reporter.part_ended("changes nothing on this log")
        else:
            rows.append(row)
            reporter.part_ended(f"{sum(row['seconds'].values()):.1f} s of stages")
    return rows, failed


@task(name="cell", task_run_name="{cell.name}", persist_result=False, cache_policy=NO_CACHE)
def cell_task(sweep: Sweep, cell: Cell) -> dict[str, Any] | None:
    """Measures one cell as a Prefect task, see :func:`flows.cost_sweep.cell.run_cell`."""
    return run_cell(sweep, cell, run_reported_stage)


def write_results(
    out: Path,
    sweep: Sweep,
    rows: Sequence[dict[str, Any]],
    left_out: Sequence[str],
    command: str,
    speed: Mapping[str, str],
) -> list[str]:
    """Writes ``cost.parquet``, ``cost_cells.parquet``, ``cost.png`` and ``cost.md``, each whole or not at all.

    Args:
        out: folder to write into.
        sweep: preset, settings and store.
        rows: of the measured cells.
        left_out: a line for each cell that failed.
        command: makes the files again.
        speed: how fast the machine is; into the tables, for predictions on another machine.

    Returns:
        The paths of the files.
    """
    out.mkdir(parents=True, exist_ok=True)
    summaries = summarise_settings(rows)
    novel_measure = novel_view_measure(rows)
    facts = {
        "command": command,
        "preset": " ".join([sweep.preset, *sweep.settings]),
        "logs": ", ".join(sorted({f"{r['log']} chunk {r['chunk']}" for r in rows})),
        "seeds": ", ".join(map(str, sorted({r["seed"] for r in rows}))),
        **machine_facts(),
    }
    # For programs that read the table, not for the page: budgets look up their preset and the machine's speed here.
    basis = {"base": sweep.preset, "settings": json.dumps(sweep.settings), "judged": novel_measure.name, **speed}
    files = [out / name for name in ("cost.parquet", "cost_cells.parquet", "cost.png", "cost.md")]
    with atomic_path(files[0]) as part:
        write_settings(part, summaries, facts | basis)
    with atomic_path(files[1]) as part:
        write_cells(part, rows, facts | basis)
    with atomic_path(files[2]) as part:
        write_png(part, draw_sweep(summaries, novel_measure, f"{facts['preset']}: {facts['logs']}"))
    bullets = [f"* {name}: {f'`{value}`' if name == 'command' else value}" for name, value in facts.items()]
    bullets += [f"* left out: {text}" for text in left_out]
    write_text(files[3], render_page(summaries, novel_measure, bullets, "cost.png"))
    return [str(file) for file in files]
