"""The sweep as a flow: cell after cell, the stages of each from the store as far as they are there."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from flows.cost_sweep.cell import Cell, Sweep, cells_of, run_cell
from flows.cost_sweep.knobs import PRESET_ITSELF, settings_of
from flows.cost_sweep.page import page
from flows.cost_sweep.parquet import write_cells, write_lines
from flows.cost_sweep.plot import drawn
from flows.cost_sweep.summary import beside, lines_of
from flows.cost_sweep.warm_up import cold_seconds, read_before
from flows.machine.calibration import calibration_s
from flows.machine.facts import commit, machine
from flows.pipeline.log_cache import chosen_chunks, expanded
from flows.pipeline.progress import current_reporter
from flows.pipeline.stage_runner import ArtifactRef, Job, produce
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import GenreError
from storage.codecs.png import write_png
from storage.files import write_file
from storage.local import open_store


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
    """Turns each knob on each log with each seed, and writes a table, a picture and a page into ``out``.

    Args:
        logs: URIs; ``pandaset:PATH/*`` stands for every sequence in a folder. chunks: of each; all if None.
        seeds: of the order of views and the fixer's noise; three if None. knobs: which; all if None.
        settings: ``section.key=value`` over the preset, for every cell.

    Finished stages come from the store: killed at any point, it goes on where it was. A cell that fails (memory) is
    left out and said; the preset's own is raised, as nothing could be compared with it.
    """
    sweep = Sweep(preset, tuple(settings or ()), store)
    cells = planned(sweep, logs, chunks, seeds, knobs)
    open_store(store).clean_temporaries()
    rows: list[dict[str, Any]] = []
    failed: dict[str, GenreError] = {}
    reporter = current_reporter()
    reporter.began("warming up")
    cold = cold_seconds(sweep)
    fastest = calibration_s()
    reporter.ended(f"{sum(cold.values()):.1f} s more than warm")
    reporter.began("reading the logs")
    read_before(sweep, cells)
    reporter.ended("each once, before anything is timed")
    for k, cell in enumerate(cells):
        reporter.began(f"{k + 1}/{len(cells)} {cell.name}")
        try:
            row = cell_task(sweep, cell)
            rows += [] if row is None else [row]
            reporter.ended("as the plan has it" if row is None else f"{sum(row['seconds'].values()):.1f} s of stages")
        except GenreError as error:
            if cell.setting.knob == PRESET_ITSELF:
                raise
            failed[cell.name] = error
            reporter.ended(f"left out: {error}")
    fastest = min(fastest, calibration_s())  # what ran beside the one is seldom there for both
    speed = {"calibration_s": f"{fastest:.4f}", "cold_seconds": json.dumps(cold)}
    told = command_of(sweep, logs, chunks, seeds, knobs)
    files = write(Path(out), sweep, rows, [f"{name}: {error}" for name, error in failed.items()], told, speed)
    return {"cells": len(rows), "failed": sorted(failed), "files": files}


def planned(
    sweep: Sweep,
    logs: Sequence[str],
    chunks: list[int] | None,
    seeds: Sequence[int] | None,
    knobs: Sequence[str] | None,
) -> list[Cell]:
    """The cells, in the order in which they run."""
    settings = settings_of(sweep.preset, sweep.settings, knobs or ())
    base = settings[0].configuration(sweep.preset, sweep.settings, 0)
    places = [(log, chunk) for log in expanded(list(logs)) for chunk in chosen_chunks(log, base, chunks)]
    return cells_of(places, (0, 1, 2) if seeds is None else seeds, settings)


def command_of(
    sweep: Sweep,
    logs: Sequence[str],
    chunks: Sequence[int] | None,
    seeds: Sequence[int] | None,
    knobs: Sequence[str] | None,
) -> str:
    """The command that sweeps the same cells again."""
    lists = {"--chunks": chunks, "--seeds": seeds, "--knobs": knobs}
    chosen = [part for name, values in lists.items() if values for part in (name, ",".join(map(str, values)))]
    sets = [part for setting in sweep.settings for part in ("--set", setting)]
    return shlex.join(["genre", "cost", *logs, "--preset", sweep.preset, *chosen, *sets])


@task(name="cell", task_run_name="{cell.name}", persist_result=False, cache_policy=NO_CACHE)
def cell_task(sweep: Sweep, cell: Cell) -> dict[str, Any] | None:
    """A row of the sweep, see :func:`flows.cost_sweep.cell.run_cell`."""

    def produced(stage: str, job: Job, inputs: dict[str, ArtifactRef]) -> ArtifactRef:
        return produce(stage, job, inputs, progress=current_reporter().progress)

    return run_cell(sweep, cell, produced)


def write(
    out: Path,
    sweep: Sweep,
    rows: Sequence[dict[str, Any]],
    failed: Sequence[str],
    command: str,
    speed: Mapping[str, str],
) -> list[str]:
    """``cost.parquet``, ``cost_cells.parquet``, ``cost.png`` and ``cost.md``, each whole or not at all.

    ``command`` makes them again. ``speed`` of the machine goes into the tables, for whoever predicts from them.
    """
    out.mkdir(parents=True, exist_ok=True)
    lines, judged = lines_of(rows), beside(rows)
    where = sorted({f"{r['log']} chunk {r['chunk']}" for r in rows})
    seeds = sorted({r["seed"] for r in rows})
    facts = {
        "command": command,
        "preset": " ".join([sweep.preset, *sweep.settings]),
        "logs": ", ".join(where),
        "seeds": ", ".join(map(str, seeds)),
        "machine": machine(),
        "commit": commit(),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
    }
    basis = {"base": sweep.preset, "settings": json.dumps(sweep.settings), "judged": judged.name, **speed}
    files = [out / name for name in ("cost.parquet", "cost_cells.parquet", "cost.png", "cost.md")]
    with atomic_path(files[0]) as part:
        write_lines(part, lines, facts | basis)
    with atomic_path(files[1]) as part:
        write_cells(part, rows, facts | basis)
    with atomic_path(files[2]) as part:
        write_png(part, drawn(lines, judged, f"{facts['preset']}: {facts['logs']}"))
    said = [f"* {name}: {f'`{value}`' if name == 'command' else value}" for name, value in facts.items()] + [
        f"* left out: {text}" for text in failed
    ]
    with atomic_path(files[3]) as part:
        write_file(part, page(lines, judged, said, "cost.png").encode())
    return [str(file) for file in files]
