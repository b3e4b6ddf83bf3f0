"""A table of the paper as a flow: method after method on every chunk, from the store as far as it is there."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from flows.machine.facts import commit, machine
from flows.paper_tables.layouts import Cell
from flows.paper_tables.measure import Place, measure
from flows.paper_tables.page import differences_from_the_paper, page, put_into
from flows.paper_tables.parquet import write_cells
from flows.paper_tables.prediction import not_stored, predicted
from flows.paper_tables.request import Planned, Request
from flows.paper_tables.warm_up import warm_up
from flows.pipeline.progress import current_reporter
from flows.pipeline.stage_runner import ArtifactRef, Job, produce
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import GenreError
from storage.files import write_file
from storage.local import open_store


@flow(name="paper-table", flow_run_name="table {number}", persist_result=False, validate_parameters=False)
def paper_table(
    number: int,
    logs: list[str],
    preset: str = "small",
    store: str = "genre-store",
    chunks: list[int] | None = None,
    settings: list[str] | None = None,
    methods: list[str] | None = None,
    weights: list[str] | None = None,
    out: str = "tables",
    into: str | None = None,
    remarks: list[str] | None = None,
    stored: bool = False,
) -> dict[str, Any]:
    """Measures a table of the paper on ``logs``, and writes it into ``out`` with the paper's numbers beside.

    Args:
        number: 1 to 5. logs: URIs, all of one dataset; ``pandaset:PATH/*`` stands for every sequence in a folder.
        chunks: of each; all if None. settings: ``section.key=value`` over the preset and the paper's protocol.
        methods: YAML files of further methods, see ``flows/paper_tables/methods.py``.
        weights: ``NAME=PATH`` of weights that do not ship. into: a Markdown page whose section of this table is
            written anew.

    Finished stages come from the store: killed at any point, it goes on where it was. A method that fails on a chunk
    is left out and said, and raised if none is left.
    """
    request = Request(
        number,
        tuple(logs),
        preset,
        store,
        None if chunks is None else tuple(chunks),
        tuple(settings or ()),
        tuple(methods or ()),
        tuple(weights or ()),
        out,
        into,
        tuple(remarks or ()),
        stored,
    )
    plan = request.planned()
    if stored:
        plan = replace(plan, missing=not_stored(plan) | plan.missing)
    open_store(store).clean_temporaries()
    reporter = current_reporter()
    if any(row["seconds"] > 0 for row in predicted(plan)):  # else nothing is timed
        reporter.began("warming up")
        warm_up(plan.basis, plan.layout)
        reporter.ended("imports, weights and first calls are in no stage's seconds")
    cells: list[Cell] = []
    failed: dict[str, GenreError] = {}
    rows = [row for row in plan.layout.rows if row.label not in plan.missing]
    for k, (place, row) in enumerate((p, r) for p in plan.places for r in rows):
        if row.label in failed:
            continue
        reporter.began(f"{k + 1}/{len(plan.places) * len(rows)} {row.label} · {place}")
        try:
            cell = cell_task(plan, row.label, place)
            cells.append(cell)
            reporter.ended(f"{sum(cell.seconds.values()):.1f} s of stages")
        except GenreError as error:
            failed[row.label] = error
            reporter.ended(f"left out: {error}")
    left = [c for c in cells if c.method not in failed]
    if not left and failed:
        raise next(iter(failed.values()))
    told = plan.missing | {name: f"it failed: {error}" for name, error in failed.items()}
    files = write(request, plan, left, told)
    return {"cells": len(left), "failed": sorted(failed), "files": files}


@task(name="table-cell", task_run_name="{label} {place}", persist_result=False, cache_policy=NO_CACHE)
def cell_task(plan: Planned, label: str, place: Place) -> Cell:
    """See :func:`flows.paper_tables.measure.measure`."""

    def produced(stage: str, job: Job, inputs: dict[str, ArtifactRef]) -> ArtifactRef:
        return produce(stage, job, inputs, progress=current_reporter().progress)

    method = next(row.method for row in plan.layout.rows if row.label == label)
    return measure(plan.basis, plan.layout, replace(method, name=label), place, produced)


def write(request: Request, plan: Planned, cells: Sequence[Cell], missing: dict[str, str]) -> list[str]:
    """``tableN_DATASET.parquet`` and ``.md`` in ``out``, and the section of ``into``; each whole or not at all."""
    out = Path(request.out)
    out.mkdir(parents=True, exist_ok=True)
    facts = facts_of(request, plan, cells)
    apart = differences_from_the_paper(plan.layout, plan.config, plan.dataset, len(plan.places))
    said = [f"* {name}: {value}" for name, value in facts.items()]
    text = page(plan.layout, cells, missing, said, apart, plan.dataset)
    written = [out / f"table{request.number}_{plan.dataset}.{kind}" for kind in ("parquet", "md")]
    with atomic_path(written[0]) as part:
        basis = {"basis": json.dumps(plan.config.model_dump(mode="json"))}
        write_cells(part, plan.layout, cells, missing, facts | basis)
    with atomic_path(written[1]) as part:
        write_file(part, text.encode())
    if request.into is not None:
        written.append(Path(request.into))
        put_into(written[-1], request.number, plan.dataset, text)
    return [str(path) for path in written]


def facts_of(request: Request, plan: Planned, cells: Sequence[Cell]) -> dict[str, str]:
    """What the numbers are of, by name."""
    config = plan.config
    facts = {
        "command": f"`{request.command}`",
        "preset": " ".join([request.preset, *request.settings]),
        "logs": ", ".join(map(str, plan.places)),
        "images": f"{config.ingest.width_px}×{config.ingest.height_px}",
        "machine": machine(),
        "commit": commit(),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
    }
    counts = {
        group: sorted({int(c.metrics[f"{group}/n"]) for c in cells if f"{group}/n" in c.metrics})
        for group in ("interpolation", "shift_3m")
    }
    for group, name in (("interpolation", "held-out images a chunk"), ("shift_3m", "images at a shift, a chunk")):
        if counts[group]:
            facts[name] = ", ".join(map(str, counts[group]))
    if request.remarks:
        facts["remark"] = " ".join(request.remarks)
    return facts
