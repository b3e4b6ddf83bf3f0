"""``genre run``: one log through the whole pipeline, with progress, a table at the end and a report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.options import (
    ChunksOption,
    DryRunOption,
    JsonOption,
    LogArgument,
    PresetOption,
    SettingsOption,
    StoreOption,
)
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_PRESET, DEFAULT_STORE

if TYPE_CHECKING:
    from flows.reconstruction.left_out import ChunksLeftOutError
    from genre_tasks.config import PipelineConfig


ConfigFileOption = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path, metavar="PATH", help="A YAML file with settings over the preset; --set goes over both."
    ),
]
StrictOption = Annotated[
    bool,
    typer.Option(
        "--strict", help="Stop at what `genre check` warns of and at unreadable files, instead of going on without."
    ),
]
BudgetOption = Annotated[
    str | None,
    typer.Option(
        help="How long the run may take from the command's start, such as 90s, 5m or 1h; evaluation does not count. "
        "The most accurate settings that fit are chosen."
    ),
]
MemoryOption = Annotated[
    str | None,
    typer.Option(
        help="How much memory the process may take, such as 4GB; the machine's if not given. What does not fit is "
        "worked on in parts, with the same result."
    ),
]
TableOption = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="The settings that --budget chooses from: a cost.parquet of `genre cost`. The preset's own table if not "
        "given.",
    ),
]


@dataclass(frozen=True)
class RunRequest:
    """What the user asks for, read and checked.

    Attributes:
        log: the log's URI.
        preset: name of the preset.
        store: folder (or URI) of the store.
        chunks: numbers of chunks; ``None`` for all.
        config: the effective configuration.
        budget_s: seconds that the run may take; ``None`` for no limit.
        start_time: when the command began, seconds since the epoch.
        table: what a budget chooses from; ``None`` for the preset's table.
    """

    log: str
    preset: str
    store: str
    chunks: list[int] | None
    config: PipelineConfig
    budget_s: float | None
    start_time: float
    table: str | None


def run(
    log: LogArgument,
    preset: PresetOption = DEFAULT_PRESET,
    config: ConfigFileOption = None,
    store: StoreOption = DEFAULT_STORE,
    chunks: ChunksOption = None,
    settings: SettingsOption = None,
    strict: StrictOption = False,
    budget: BudgetOption = None,
    table: TableOption = None,
    memory: MemoryOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Reconstruct a driving log and write a report.

    The log goes through ingest, effects, the initial scene, GNet, novel views, FNet, ENet and evaluation, chunk by
    chunk. The store keeps the result of every stage. A stage whose inputs and settings have not changed is taken from
    there, so a run that was stopped goes on where it was.

    The report and the run's record are written to STORE/runs/RUN/report.html and run.json.

    Example:

    \b
        genre run 'synthetic:street?seed=1000' --preset demo
        genre run pandaset:data/002 --chunks 0,1 --set gnet.iterations=96
        genre run pandaset:data/002 --budget 5m
    """
    import psutil

    from flows.cli.outcome import add_facts
    from flows.cli.parsing import parse_duration, parse_memory, parse_numbers
    from flows.configuration import load_configuration
    from flows.configuration.absolute_paths import make_paths_absolute
    from genre_tasks.logs.registry import make_log_absolute

    # Known from here on, whatever happens: what a program reads where the run does not come to its end.
    add_facts(log=log, preset=preset, store=store, run=None, report=None, chunks=[], left_out=[])
    # Over the settings, as --strict is the more explicit wish.
    strict_settings = ["ingest.strict=true"] if strict else []
    memory_gib = parse_memory(memory, "--memory")
    limit_settings = [] if memory_gib is None else [f"limits.memory_gib={memory_gib!r}"]
    effective = load_configuration(preset, config, [*(settings or []), *strict_settings, *limit_settings])
    request = RunRequest(
        log=make_log_absolute(log),
        preset=preset,
        store=store,
        chunks=parse_numbers(chunks, "--chunks"),
        # The record names files and the log, and is read from other folders.
        config=make_paths_absolute(effective),
        budget_s=parse_duration(budget, "--budget"),
        # A budget counts from when the user pressed return, imports included.
        start_time=psutil.Process().create_time(),
        table=None if table is None else str(table),
    )
    check_request(request)
    if dry_run:
        print_dry_run(request, as_json)
    else:
        reconstruct(request, as_json)


def check_request(request: RunRequest) -> None:
    """Checks all that the run needs: a mistake shows here, before Prefect's server takes seconds to start.

    Args:
        request: what the user asks for.

    Raises:
        GenreError: as :func:`flows.preflight.requirements.check_requirements` raises it.
    """
    from flows.preflight.requirements import check_requirements
    from genre_tasks.errors import ConfigError

    # Warnings are left to the run itself, which checks again wherever it runs.
    check_requirements(
        request.log, request.store, request.chunks, request.config, has_budget=request.budget_s is not None
    )
    if request.budget_s is not None:
        from flows.budget.budget import resolve_table
        from flows.budget.memory_filter import keep_points_that_fit

        table = resolve_table(request.table, request.preset, request.config)
        # Raises where the limit on memory is too low for every setting.
        keep_points_that_fit(table, request.config, request.log)
    elif request.table is not None:
        raise ConfigError("--table is what --budget chooses from", remedy="Give a --budget, too, or leave it out.")


def reconstruct(request: RunRequest, as_json: bool) -> None:
    """Runs what was asked for, and prints the result.

    Args:
        request: what the user asks for.
        as_json: one JSON object instead of tables.

    Raises:
        GenreError: as the flow raises it.
    """
    from flows.cli.outcome import add_facts
    from flows.cli.terminal import report_on_terminal
    from flows.reconstruction.left_out import ChunksLeftOutError

    record = _find_stored_record(request)
    if record is not None:
        _print_result(record, as_json)
        return
    with report_on_terminal():
        from flows.reconstruction.flow import reconstruct_log

        try:
            record = reconstruct_log(
                request.log,
                preset=request.preset,
                store=request.store,
                chunks=request.chunks,
                config=request.config.model_dump(mode="json"),
                budget_s=request.budget_s,
                start_time=request.start_time,
                table=request.table,
            )
        except ChunksLeftOutError as error:
            if error.record is None:
                add_facts(left_out=error.left_out)
            else:
                _print_result(error.record, as_json, error)
            raise
    _print_result(record, as_json)


def _find_stored_record(request: RunRequest) -> dict[str, Any] | None:
    """The record of a run that finds every stage in the store, without Prefect; ``None`` for any other."""
    from flows.cli.terminal import TerminalReporter
    from flows.prefect_api.settings_sources import API_URL, find_source
    from flows.reconstruction.run_records import summarise_run, write_run_record
    from flows.reconstruction.stored_run import find_stored_run

    # A budget chooses the stages while it goes on, and who has a server wants to see every run there.
    if request.budget_s is not None or find_source(API_URL) is not None:
        return None
    with TerminalReporter("looking into the store") as reporter:
        run = find_stored_run(request.log, request.preset, request.store, request.chunks, request.config)
        if run is None:
            return None
        for chunk, refs in run.chunks.items():
            for stage, ref in refs.items():
                reporter.stage_ended(stage, chunk, ref)
        return write_run_record(run, summarise_run(run), {})


def _print_result(record: dict[str, Any], as_json: bool, error: ChunksLeftOutError | None = None) -> None:
    from flows.cli.outcome import print_outcome
    from flows.cli.run_tables import print_run

    if as_json:
        # Without the configuration, which `genre show RUN` prints: a program that reads this wants results.
        shown = ("log", "preset", "store", "run", "report", "chunks", "left_out", "budget")
        facts = {key: record[key] for key in shown if key in record}
        print_outcome(record["status"], facts, error)
    else:
        print_run(record)


def print_dry_run(request: RunRequest, as_json: bool) -> None:
    """Prints what the run would compute.

    Args:
        request: what the user asks for.
        as_json: one JSON object instead of tables.

    Raises:
        GenreError: what the run needs is missing.
    """
    from flows.cli.outcome import print_outcome
    from flows.cli.run_tables import print_prediction
    from flows.configuration import diff_from_preset
    from flows.pipeline.definition import RECONSTRUCTION_STAGES
    from flows.pipeline.prediction import predict_run
    from flows.preflight.requirements import check_requirements

    config = request.config
    report = check_requirements(
        request.log, request.store, request.chunks, config, has_budget=request.budget_s is not None
    )
    # A budget may end the first chunk earlier; without one every chunk goes to the last stage.
    end = RECONSTRUCTION_STAGES[-1]
    if request.budget_s is not None:
        config, end = _first_choice(request, request.budget_s)
    prediction: dict[str, Any] = predict_run(request.log, request.store, request.chunks, config, end)
    differs = {key: list(values) for key, values in diff_from_preset(config, request.preset).items()}
    prediction |= {"preset": request.preset, "differs": differs}
    prediction |= {"checked": list(report.checked), "warnings": list(report.warnings)}
    if as_json:
        print_outcome("done", prediction)
    else:
        print_prediction(prediction)


def _first_choice(request: RunRequest, budget_s: float) -> tuple[PipelineConfig, str]:
    """What the first chunk would begin with and the stage where that ends; printed to stderr, too."""
    from flows.budget.budget import Budget
    from flows.pipeline.log_cache import select_chunks

    budget = Budget(budget_s, request.start_time, request.table, request.preset, request.config)
    chunks = select_chunks(request.log, request.config, request.chunks)
    typer.echo(budget.describe(), err=True)
    chooser = budget.make_chooser(request.log, chunks[0])
    # A run waits with this until ingest is done, as Prefect's server starts meanwhile; nothing starts here.
    chooser.calibrate()
    step = chooser.next_stage(1 / len(chunks))
    typer.echo(f"chunk {chunks[0]}: {chooser.choices[0]} (Prefect's start would be counted, too)", err=True)
    return request.config if step is None else step[1], str(chooser.as_record()["end"])
