"""The flow of one log: GNet → novel views → FNet → ENet."""

from __future__ import annotations

import base64
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect import flow
from prefect.artifacts import create_image_artifact, create_link_artifact, create_table_artifact

from flows.configuration import diff_from_preset, load_configuration, validate_config
from flows.configuration.absolute_paths import make_paths_absolute
from flows.defaults import DEFAULT_PRESET, DEFAULT_STORE
from flows.pipeline.definition import PIPELINE, RECONSTRUCTION_STAGES, STAGE_BY_NAME, StageSpec
from flows.pipeline.log_cache import select_chunks
from flows.pipeline.progress import get_reporter
from flows.pipeline.stage_runner import ArtifactRef, Job
from flows.pipeline.stage_task import stage_task
from flows.preflight.requirements import ALL_STAGES, check_requirements
from flows.reconstruction.chunk_configuration import read_chunk_config
from flows.reconstruction.left_out import ChunksLeftOutError, record_failures
from flows.reconstruction.outcome_artifact import is_child_run, publish_outcome
from flows.reconstruction.run_records import FinishedRun, find_run_record, summarise_run, write_run_record
from flows.reconstruction.run_summary import RunSummary
from flows.reconstruction.stored_run import find_stored_run
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ConfigError, GenreError
from genre_tasks.logs.registry import make_log_absolute
from storage.opening import open_store

if TYPE_CHECKING:
    from flows.budget.budget import Budget
    from flows.budget.chooser import Chooser


# Parameters are not validated by Prefect: the configuration's own models do it, and their errors say what to do.
@flow(name="reconstruct-log", flow_run_name="{log}", persist_result=False, validate_parameters=False)
def reconstruct_log(
    log: str,
    preset: str = DEFAULT_PRESET,
    store: str = DEFAULT_STORE,
    chunks: list[int] | None = None,
    config: dict[str, Any] | None = None,
    settings: list[str] | None = None,
    budget_s: float | None = None,
    start_time: float | None = None,
    table: str | None = None,
) -> dict[str, Any]:
    """Reconstructs and enhances one driving log, chunk by chunk, and writes a report into the store.

    With a budget, the most accurate setting that fits into the time is chosen, and again before each stage. A chunk
    that cannot be reconstructed is left out; the others go on. Record and report are then written with what was left
    out, and the error is raised at the end.

    Args:
        log: the log's URI, such as ``pandaset:PATH/002`` or ``synthetic:street?seed=1000``.
        preset: demo, small, fine, long, hd or paper.
        store: folder (or URI) of the store.
        chunks: numbers of the chunks; ``None`` for all.
        config: a whole effective configuration as JSON values, in place of the preset's.
        settings: ``section.key=value`` strings over the preset; not used together with ``config``.
        budget_s: seconds that the run may take from ``start_time`` on, evaluation not counted; ``None`` for no limit.
        start_time: when the run began, in seconds since the epoch; ``None`` for now.
        table: the cost.parquet that a budget chooses from; ``None`` for the table that ships with the preset.

    Returns:
        The run's record as plain values, as ``run.json`` holds it.

    Raises:
        ConfigError: a setting is wrong, or no table fits to the budget.
        ChunksLeftOutError: some of several chunks cannot be reconstructed; it has the record of the others.
        GenreError: any other kind, as a stage of the only chunk raises it.

    Example::

        print(reconstruct_log("synthetic:street?seed=1000", preset="demo", store="genre-store")["report"])
    """
    try:
        # The record names the log and files, and is read from other folders.
        log = make_log_absolute(log)
        effective = make_paths_absolute(_effective_config(preset, config, settings))
        record = _take_from_store(log, preset, store, chunks, effective) if budget_s is None else None
        if record is None:
            budget = None if budget_s is None else _open_budget(budget_s, start_time, table, preset, effective)
            record = _compute(log, preset, store, chunks, effective, budget)
    except Exception as error:
        publish_outcome(log, getattr(error, "record", None), error)
        raise
    publish_outcome(log, record, None)
    return record


@flow(name="recompute-run", flow_run_name="{run}", persist_result=False, validate_parameters=False)
def recompute_run(store: str, run: str) -> None:
    """Computes what the store lacks of a finished run, with the settings that each chunk was made with.

    The run's record stays as it is. Artifacts come out with the same keys unless code, weights or the log have changed.

    Args:
        store: folder (or URI) of the store.
        run: the run's name.

    Raises:
        GenreError: a chunk cannot be computed; the others are, before the first error is raised.
    """
    record = find_run_record(store, run)
    failures: list[GenreError] = []
    for entry in record["chunks"]:
        chunk = entry["chunk"]
        try:
            config = read_chunk_config(record, chunk)
            # Within a budget a chunk may end at GNet's scene, as memory may be too small for what follows.
            made = {stage["stage"] for stage in entry["stages"]}
            specs = [spec for spec in PIPELINE if spec.name in made]
            _check_needs(record["log"], store, [chunk], config, [spec.name for spec in specs])
            job = Job(record["log"], chunk, store, config.model_dump(mode="json"))
            refs: dict[str, ArtifactRef] = {}
            for spec in specs:
                refs[spec.name] = _run_stage_task(spec, job, refs)
        except GenreError as error:
            failures.append(error)
    if failures:
        raise failures[0]


def _open_budget(
    budget_s: float, start_time: float | None, table: str | None, preset: str, config: PipelineConfig
) -> Budget:
    # Tables of costs take a tenth of the time of a run that is in the store, and few runs have a budget.
    from flows.budget.budget import Budget

    return Budget(budget_s, start_time, table, preset, config)


def _take_from_store(
    log: str, preset: str, store: str, chunks: list[int] | None, config: PipelineConfig
) -> dict[str, Any] | None:
    """The record of a child run that finds every stage in the store; ``None`` for any other."""
    # Without tasks and the artifacts of stages: of a thousand logs, most may be done already.
    run = find_stored_run(log, preset, store, chunks, config) if is_child_run() else None
    return None if run is None else write_run_record(run, summarise_run(run), {})


def _compute(
    log: str, preset: str, store: str, chunks: list[int] | None, effective: PipelineConfig, budget: Budget | None
) -> dict[str, Any]:
    selected = _check_needs(log, store, chunks, effective, budget=budget)
    # A killed run may have left half-written folders behind; no artifact is among them.
    open_store(store).clean_temporaries()
    values = effective.model_dump(mode="json")
    done, failures = _reconstruct_chunks(log, store, values, selected, budget)
    notes = {} if budget is None else {chunk: budget.choosers[chunk].describe() for chunk in done}
    run = FinishedRun(
        log=log,
        preset=preset,
        store=store,
        config=values,
        differs=diff_from_preset(effective, preset),
        chunks=done,
        notes=notes,
        left_out=record_failures(log, failures),
    )
    summary = summarise_run(run)
    record = write_run_record(run, summary, {} if budget is None else {"budget": budget.as_record()})
    # After the record is written: if Prefect's server fails now, the run is complete nevertheless.
    _publish_to_prefect(summary, Path(record["report"]))
    if failures:
        raise ChunksLeftOutError(log, len(selected), failures, record)
    return record


def _effective_config(preset: str, config: dict[str, Any] | None, settings: list[str] | None) -> PipelineConfig:
    if config is None:
        return load_configuration(preset, settings=settings or ())
    # The values may come from a worker's parameters, which anyone can write by hand.
    return validate_config(config, "parameters of the flow")


def _check_needs(
    log: str,
    store: str,
    chunks: list[int] | None,
    config: PipelineConfig,
    stages: Iterable[str] = ALL_STAGES,
    budget: Budget | None = None,
) -> list[int]:
    """Checks all that the run needs before any work; the chunks to run."""
    # The command has checked this, too, but a worker may be on another machine.
    report = check_requirements(log, store, chunks, config, stages, has_budget=budget is not None)
    for warning in report.warnings:
        get_reporter().message(f"warning: {warning}")
    if budget is not None:
        # One error here, and not one for each chunk.
        budget.keep_what_fits(log)
    return select_chunks(log, config, chunks)


def _reconstruct_chunks(
    log: str, store: str, config: dict[str, Any], chunks: list[int], budget: Budget | None
) -> tuple[dict[int, dict[str, ArtifactRef]], dict[int, GenreError]]:
    """The references of every chunk that could be reconstructed, and the errors of those that could not."""
    done: dict[int, dict[str, ArtifactRef]] = {}
    failures: dict[int, GenreError] = {}
    if budget is not None:
        get_reporter().message(budget.describe())
    for position, chunk in enumerate(chunks):
        job = Job(log, chunk, store, config)
        try:
            if budget is None:
                done[chunk] = _reconstruct_chunk(job)
            else:
                # Chunks that are not begun yet share the time that is left equally.
                fraction = 1 / (len(chunks) - position)
                done[chunk] = _reconstruct_within(job, budget.make_chooser(log, chunk), fraction)
        except ConfigError:
            # A setting that is wrong for one chunk is wrong for all of them, and there is nothing to wait for.
            raise
        except GenreError as error:
            # With a single chunk the error itself is the message.
            if len(chunks) > 1:
                get_reporter().message(f"chunk {chunk} is left out: {error}")
            failures[chunk] = error
    # Without any chunk there is nothing to report on.
    if not done and len(chunks) == 1:
        raise failures[chunks[0]]
    if not done and failures:
        raise ChunksLeftOutError(log, len(chunks), failures)
    return done, failures


def _reconstruct_chunk(job: Job) -> dict[str, ArtifactRef]:
    refs: dict[str, ArtifactRef] = {}
    for spec in PIPELINE:
        refs[spec.name] = _run_stage_task(spec, job, refs)
    return refs


def _reconstruct_within(job: Job, chooser: Chooser, fraction: float) -> dict[str, ArtifactRef]:
    """Runs the stages that the chooser names; the last scene may be GNet's. Evaluation stops the deadline's count."""
    refs: dict[str, ArtifactRef] = {}
    while True:
        reported = len(chooser.choices)
        step = chooser.next_stage(fraction)
        for choice in chooser.choices[reported:]:
            get_reporter().message(f"chunk {job.chunk}  before {choice.before}: {choice}")
        if step is None:
            break
        stage, config = step
        # From here on the stages are made with the setting that fits now; finished ones are the same in both.
        job = replace(job, config=config.model_dump(mode="json"))
        start = time.monotonic()
        refs[stage] = _run_stage_task(STAGE_BY_NAME[stage], job, refs)
        chooser.record_stage(stage, time.monotonic() - start, refs[stage].cached)
    # Evaluation is no part of what a budget buys, so its time does not count.
    with chooser.deadline.paused():
        for spec in PIPELINE:
            if spec.name not in RECONSTRUCTION_STAGES and all(name in refs for name in spec.inputs):
                refs[spec.name] = _run_stage_task(spec, job, refs)
    return refs


def _run_stage_task(spec: StageSpec, job: Job, refs: dict[str, ArtifactRef]) -> ArtifactRef:
    inputs = {name: refs[name] for name in spec.inputs}
    # By way of the state, as the task may end in a state of its own, which is named Cached.
    ref: ArtifactRef = stage_task(spec.name, job.chunk, job, inputs, return_state=True).result()
    return ref


def _publish_to_prefect(summary: RunSummary, report: Path) -> None:
    """Shows a link to the report, tables and a few pictures in Prefect's UI; the report has all of them."""
    # A worker may be on another machine than the reader: the path is then one of the worker's.
    create_link_artifact(
        link=report.absolute().as_uri(),
        link_text=f"report of run {summary.run}",
        key="report",
        description=f"{summary.log}, preset {summary.preset}",
    )
    for chunk in summary.chunks:
        rows = [
            {"stage": s.stage, "served": "cache" if s.cached else "computed", "seconds": round(s.seconds, 2)}
            | {name: round(value, 4) for name, value in s.metrics.items()}
            for s in chunk.stages
        ]
        create_table_artifact(table=rows, key=f"chunk-{chunk.chunk}", description=f"{summary.log}, chunk {chunk.chunk}")
        for stage in chunk.stages:
            # One picture of a stage is enough: Prefect keeps it as text in its database.
            for name, png in sorted(stage.pictures.items())[:1]:
                create_image_artifact(
                    image_url=_data_url(png), key=f"chunk-{chunk.chunk}-{_slug(stage.stage)}", description=name
                )


def _data_url(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _slug(text: str) -> str:
    # Keys of Prefect's artifacts allow lower-case letters, digits and dashes alone.
    return "".join(character if character.isalnum() else "-" for character in text.lower())
