"""A table of the paper as a flow: method after method on every chunk, from the store as far as it is there."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from flows.enhancement.enhancement_request import EnhancementInputs
from flows.experiments.log_chunks import LogChunk
from flows.experiments.result_files import machine_facts, write_text
from flows.experiments.stages import run_reported_stage
from flows.paper_tables.agreement_cells import measure_agreement_cell
from flows.paper_tables.columns import MeasuredCell
from flows.paper_tables.measure import measure_cell, warm_up
from flows.paper_tables.page import list_differences, render_page
from flows.paper_tables.page_sections import replace_section
from flows.paper_tables.parquet import write_cells
from flows.paper_tables.request import (
    CheckedRequest,
    TableRequest,
    describe_places,
    find_unstored_methods,
    predict_stages,
)
from flows.paper_tables.rollout_cells import measure_rollout_cell
from flows.pipeline.progress import get_reporter
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import GenreError, InputError
from storage.opening import open_store


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
    scene: dict[str, Any] | None = None,
    detector: str | None = None,
) -> dict[str, Any]:
    """Measures a table of the paper, and writes it with the paper's numbers beside the measured ones.

    Finished stages come from the store: killed at any point, it goes on where it was. A method that fails on a chunk
    is left out, and the table says so.

    Args:
        number: of the table, 1 to 7.
        logs: URIs, all of one dataset; ``pandaset:PATH/*`` stands for every sequence in a folder. None with a scene.
        preset: name of the preset.
        store: folder of the store.
        chunks: of each log; all if ``None``.
        settings: ``section.key=value`` over the preset and the paper's protocol.
        methods: YAML files of further methods, see ``flows/paper_tables/user_methods.py``.
        weights: ``NAME=PATH`` of weights that do not ship.
        out: folder to write into.
        into: a Markdown page whose section of this table is replaced.
        remarks: what else the reader should know.
        stored: compute nothing, and leave out the methods that the store has not completely.
        scene: a scene of another program in the place of logs, see :meth:`EnhancementInputs.to_values`.
        detector: file or name of the detector that table 7 asks.

    Returns:
        ``cells``, their number; ``failed``, labels of methods that failed; ``files`` that were written.

    Raises:
        GenreError: the request is wrong, or no method is left.
    """
    request = TableRequest(
        number=number,
        logs=tuple(logs),
        preset=preset,
        store=store,
        chunks=None if chunks is None else tuple(chunks),
        settings=tuple(settings or ()),
        methods=tuple(methods or ()),
        weights=tuple(weights or ()),
        out=out,
        into=into,
        remarks=tuple(remarks or ()),
        stored=stored,
        scene=None if scene is None else EnhancementInputs.from_values(scene),
        detector=detector,
    )
    checked = request.check()
    if stored:
        checked = replace(checked, missing=find_unstored_methods(checked) | checked.missing)
    open_store(store).clean_temporaries()
    _warm_up_if_timed(checked)
    return _measure(request, checked)


def _measure(request: TableRequest, checked: CheckedRequest) -> dict[str, Any]:
    """Runs what can be measured, and writes the table of it; gives what the flow returns."""
    cells, failed = _run_cells(checked)
    complete = [c for c in cells if c.method not in failed]
    if not complete and failed:
        raise next(iter(failed.values()))
    # A table without a row would replace one that was measured.
    if not complete:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in checked.missing.items())
        problem = f"no method of table {request.number} is left ({reasons})"
        raise InputError(problem, remedy="Check --store and --set, or leave out --stored.", file=request.store)
    missing = checked.missing | {name: f"it failed: {error}" for name, error in failed.items()}
    files = write_results(request, checked, complete, missing)
    return {"cells": len(complete), "failed": sorted(failed), "files": files}


def _warm_up_if_timed(checked: CheckedRequest) -> None:
    # What comes from the store keeps the seconds of its first computation: nothing is timed then.
    if any(row["seconds"] > 0 for row in predict_stages(checked)):
        get_reporter().part_started("warming up")
        warm_up(checked.basis, checked.layout)
        get_reporter().part_ended("imports, weights and first calls are in no stage's seconds")


def _run_cells(checked: CheckedRequest) -> tuple[list[MeasuredCell], dict[str, GenreError]]:
    """Gives the measured cells, and the error of each method that failed, which is not tried on further chunks."""
    cells: list[MeasuredCell] = []
    failed: dict[str, GenreError] = {}
    reporter = get_reporter()
    planned = [(places, row.label) for places in checked.group_places() for row in checked.measurable_rows]
    for k, (places, label) in enumerate(planned):
        # Its row is left out anyway, so its further chunks would be hours for nothing.
        if label in failed:
            continue
        reporter.part_started(f"{k + 1}/{len(planned)} {label} · {describe_places(places)}")
        try:
            cell = cell_task(checked, label, places)
        except GenreError as error:
            failed[label] = error
            reporter.part_ended(f"left out: {error}")
            continue
        cells.append(cell)
        reporter.part_ended(f"{sum(cell.seconds.values()):.1f} s of stages")
    return cells, failed


@task(name="table-cell", task_run_name="{label} {places}", persist_result=False, cache_policy=NO_CACHE)
def cell_task(checked: CheckedRequest, label: str, places: tuple[LogChunk, ...]) -> MeasuredCell:
    """Measures one cell as a Prefect task, see :func:`flows.paper_tables.measure.measure_cell`.

    Args:
        checked: the table.
        label: of the row.
        places: the chunk, or all chunks of a log where the table has rollouts.
    """
    method = replace(next(row.method for row in checked.layout.rows if row.label == label), name=label)
    if checked.layout.rollouts:
        return measure_rollout_cell(checked.basis, checked.layout, method, places, run_reported_stage)
    if checked.layout.across_cameras:
        detector = str(checked.detector)
        return measure_agreement_cell(checked.basis, checked.layout, method, places[0], detector, run_reported_stage)
    return measure_cell(checked.basis, checked.layout, method, places[0], run_reported_stage)


def write_results(
    request: TableRequest, checked: CheckedRequest, cells: Sequence[MeasuredCell], missing: dict[str, str]
) -> list[str]:
    """Writes ``tableN_DATASET.parquet`` and ``.md``, and the section of the user's page; each whole or not at all.

    Args:
        request: what the user asked for.
        checked: the same, checked.
        cells: what was measured.
        missing: label of a row → why it was not measured.

    Returns:
        The paths of the files.

    Raises:
        InputError: the page's section cannot be found.
    """
    out = Path(request.out)
    out.mkdir(parents=True, exist_ok=True)
    facts = collect_facts(request, checked, cells)
    differences = list_differences(checked.layout, checked.config, checked.dataset, len(checked.places))
    bullets = [f"* {name}: {value}" for name, value in facts.items()]
    text = render_page(checked.layout, cells, missing, bullets, differences, checked.dataset)
    files = [out / f"table{request.number}_{checked.dataset}.{kind}" for kind in ("parquet", "md")]
    with atomic_path(files[0]) as part:
        # The whole configuration is only in the file: on the page nobody would read it.
        basis = {"basis": json.dumps(checked.config.model_dump(mode="json"))}
        write_cells(part, checked.layout, cells, missing, facts | basis)
    write_text(files[1], text)
    if request.into is not None:
        page = Path(request.into)
        replace_section(page, request.number, checked.dataset, text)
        files.append(page)
    return [str(path) for path in files]


def collect_facts(request: TableRequest, checked: CheckedRequest, cells: Sequence[MeasuredCell]) -> dict[str, str]:
    """Collects what the numbers are of.

    Args:
        request: what the user asked for.
        checked: the same, checked.
        cells: what was measured.

    Returns:
        Facts by name, in the order in which the page shows them.
    """
    ingest = checked.config.ingest
    facts = {
        "command": f"`{request.command}`",
        "preset": " ".join([request.preset, *request.settings]),
        "logs": ", ".join(map(str, checked.places)),
        "images": f"{ingest.width_px}×{ingest.height_px}",
        **machine_facts(),
    }
    for group, name in (("interpolation", "held-out images a chunk"), ("shift_3m", "images at a shift, a chunk")):
        # Several counts are shown, because a mean over sets of different sizes has to be visible.
        counts = sorted({int(c.metrics[f"{group}/n"]) for c in cells if f"{group}/n" in c.metrics})
        if counts:
            facts[name] = ", ".join(map(str, counts))
    if checked.detector is not None:
        facts["detector"] = Path(checked.detector).name
    if checked.explanation:
        facts["scene"] = "; ".join(checked.explanation)
    # Every method drives the same rollouts, so a remark on one is written once.
    remarks = list(dict.fromkeys(text for cell in cells for text in cell.remarks))
    if remarks:
        facts["rollouts"] = "; ".join(remarks)
    if request.remarks:
        facts["remark"] = " ".join(request.remarks)
    return facts
