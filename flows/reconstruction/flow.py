"""The flows: one log through GNet → novel views → FNet → ENet, and a dataset of logs."""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from typing import Any

from prefect import flow
from prefect.artifacts import create_image_artifact, create_table_artifact

from flows.budget.budget import Budget
from flows.budget.chooser import Chooser
from flows.configuration import differences, load_configuration, validated
from flows.pipeline.definition import BY_NAME, PIPELINE, RECONSTRUCTING, StageSpec
from flows.pipeline.log_cache import chosen_chunks, expanded
from flows.pipeline.progress import current_reporter
from flows.pipeline.stage_runner import ArtifactRef, Job
from flows.pipeline.stage_task import stage_task
from flows.reconstruction.run_records import Run, finish_run, summary_of
from flows.reconstruction.run_summary import RunSummary
from genre_tasks.errors import GenreError, InputError
from storage.local import open_store

_log = logging.getLogger("genre")


@flow(name="reconstruct-log", flow_run_name="{log}", persist_result=False, validate_parameters=False)
def reconstruct_log(
    log: str,
    preset: str = "small",
    store: str = "genre-store",
    chunks: list[int] | None = None,
    config: dict[str, Any] | None = None,
    settings: list[str] | None = None,
    budget_s: float | None = None,
    began: float | None = None,
    table: str | None = None,
) -> dict[str, Any]:
    """Reconstructs and enhances one driving log, chunk by chunk; returns the run's summary as plain values.

    Args:
        log: ``pandaset:PATH/002`` or ``synthetic:street?seed=1000``.
        preset: demo, small, long or paper. store: a folder or URI.
        chunks: which chunks; all if None. config: a whole effective configuration (it overrides the preset's).
        settings: ``section.key=value`` strings, applied last.
        budget_s: seconds that the run may take from ``began`` on (since the epoch; the flow's start without it),
            evaluation not counted: the most accurate setting of ``table`` (a sweep's cost.parquet; the preset's own
            without it) that fits is chosen, and again before each stage.

    A chunk that its input makes impossible is left out and the others go on; the error is raised at the end.
    """
    if config is None:
        effective = load_configuration(preset, settings=settings or ())
    else:
        effective = validated(config, "parameters of the flow")
    values = effective.model_dump(mode="json")
    failed: list[GenreError] = []
    done: dict[int, dict[str, ArtifactRef]] = {}
    open_store(store).clean_temporaries()  # what killed runs left half-written
    chosen = chosen_chunks(log, effective, chunks)
    budget = None if budget_s is None else Budget(budget_s, began, table, preset, effective)
    if budget is not None:
        current_reporter().said(budget.told())
    for k, chunk in enumerate(chosen):
        job = Job(log, chunk, store, values)
        try:
            if budget is None:
                done[chunk] = _reconstruct_chunk(job)
            else:
                done[chunk] = _reconstruct_within(job, budget.chooser(log, chunk), 1 / (len(chosen) - k))
        except InputError as error:
            if len(chosen) > 1:  # a single one raises below
                _log.error("chunk %d is left out: %s", chunk, error)
            failed.append(error)
    if not done and failed:
        raise failed[0]
    notes = {} if budget is None else {chunk: budget.choosers[chunk].told() for chunk in done}
    run = Run(log, preset, store, values, differences(effective, preset), done, notes)
    summary = summary_of(run)
    record = finish_run(run, summary, {} if budget is None else {"budget": budget.record()})
    _publish(summary)
    if failed:
        raise failed[0]
    return record


def _reconstruct_chunk(job: Job) -> dict[str, ArtifactRef]:
    refs: dict[str, ArtifactRef] = {}
    for spec in PIPELINE:
        refs[spec.name] = _staged(spec, job, refs)
    return refs


def _reconstruct_within(job: Job, chooser: Chooser, share: float) -> dict[str, ArtifactRef]:
    """As the chooser chooses: the scene may be GNet's. What is there is evaluated while the clock stands still."""
    refs: dict[str, ArtifactRef] = {}
    while True:
        told, step = len(chooser.choices), chooser.next(share)
        for choice in chooser.choices[told:]:
            current_reporter().said(f"chunk {job.chunk}  before {choice.before}: {choice}")
        if step is None:
            break
        stage, config = step
        job, begun = replace(job, config=config.model_dump(mode="json")), time.monotonic()
        refs[stage] = _staged(BY_NAME[stage], job, refs)
        chooser.done(stage, time.monotonic() - begun, refs[stage].cached)
    with chooser.clock.paused():
        for spec in PIPELINE:
            if spec.name not in RECONSTRUCTING and all(name in refs for name in spec.inputs):
                refs[spec.name] = _staged(spec, job, refs)
    return refs


def _staged(spec: StageSpec, job: Job, refs: dict[str, ArtifactRef]) -> ArtifactRef:
    inputs = {name: refs[name] for name in spec.inputs}
    done: ArtifactRef = stage_task(spec.name, job.chunk, job, inputs, return_state=True).result()
    return done


def _publish(summary: RunSummary) -> None:
    """Tables and pictures in Prefect's UI; the store has the same and more."""
    for chunk in summary.chunks:
        rows = [
            {"stage": s.stage, "served": "cache" if s.cached else "computed", "seconds": round(s.seconds, 2)}
            | {k: round(v, 4) for k, v in s.metrics.items()}
            for s in chunk.stages
        ]
        create_table_artifact(table=rows, key=f"chunk-{chunk.chunk}", description=f"{summary.log}, chunk {chunk.chunk}")
        for stage in chunk.stages:
            for name, png in sorted(stage.pictures.items())[:1]:
                create_image_artifact(
                    image_url=_data_url(png), key=f"chunk-{chunk.chunk}-{_slug(stage.stage)}", description=name
                )


def _data_url(png: bytes) -> str:
    import base64

    return "data:image/png;base64," + base64.b64encode(png).decode()


def _slug(text: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in text.lower())


@flow(name="reconstruct-dataset", persist_result=False, validate_parameters=False)
def reconstruct_dataset(
    logs: list[str],
    preset: str = "small",
    store: str = "genre-store",
    settings: list[str] | None = None,
) -> list[dict[str, Any]]:
    """Reconstructs many logs, a child flow run each; a log that fails does not stop the others.

    ``logs`` are URIs; ``pandaset:PATH/*`` stands for every sequence in a folder. Raises the first error at the end.
    """
    summaries: list[dict[str, Any]] = []
    failed: list[Exception] = []
    for log in expanded(logs):
        try:
            summaries.append(reconstruct_log(log, preset=preset, store=store, settings=settings))
        except GenreError as error:
            _log.error("%s failed: %s", log, error)
            failed.append(error)
    if failed:
        raise failed[0]
    return summaries
