"""``genre run``: one log through the whole pipeline, with progress, a table at the end and a report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from genre_tasks.config import PipelineConfig

DEFAULT_STORE = "genre-store"


def run(
    log: Annotated[str, typer.Argument(help="pandaset:PATH/002 or synthetic:street?seed=1000")],
    preset: Annotated[str, typer.Option(help="demo, small, fine, long or paper.")] = "small",
    config: Annotated[Path | None, typer.Option(help="A YAML file over the preset.")] = None,
    store: Annotated[str, typer.Option(help="A folder (or URI) that keeps every artifact.")] = DEFAULT_STORE,
    chunks: Annotated[str | None, typer.Option(help="Which chunks, e.g. 0,1; all without it.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="section.key=value, e.g. gnet.iterations=8.")] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="A missing or unreadable image or sweep is an error.")
    ] = False,
    budget: Annotated[
        str | None,
        typer.Option(help="Wall time from the command's start, e.g. 90s or 5m: the best that fits is chosen."),
    ] = None,
    table: Annotated[
        Path | None, typer.Option(help="What --budget chooses from: a cost.parquet of `genre cost` here.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be computed, and what it would take.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object to stdout.")] = False,
) -> None:
    """Reconstruct a log: GNet, novel views, FNet, ENet, evaluation and a report. Finished stages come from the store.

    Add --debug to any command for tracebacks.
    """
    import psutil

    from flows.cli.parsing import numbers, seconds
    from flows.configuration import load_configuration
    from flows.pipeline.definition import RECONSTRUCTING
    from flows.pipeline.log_cache import opened_log
    from genre_tasks.errors import ConfigError

    began = psutil.Process().create_time()
    settings = [*(set_ or []), *(["ingest.strict=true"] if strict else [])]
    effective = load_configuration(preset, config, settings)
    wanted, budget_s = numbers(chunks, "--chunks"), seconds(budget, "--budget")
    opened_log(log)  # a log that cannot be opened is said before a server is started
    if table is not None and budget_s is None:
        raise ConfigError("--table is what --budget chooses from", remedy="Give a --budget, too, or leave it out.")
    given = None if table is None else str(table)
    if budget_s is not None:
        from flows.budget.budget import table_for

        table_for(given, preset, effective)  # what does not fit is said before a server is started
    if dry_run:
        end = RECONSTRUCTING[-1]
        if budget_s is not None:
            effective, end = _chosen(log, preset, wanted, effective, budget_s, began, given)
        _dry_run(log, preset, store, wanted, effective, end, as_json)
        return
    from flows.cli.terminal import print_run, reporting

    with reporting():
        from flows.reconstruction.flow import reconstruct_log

        summary = reconstruct_log(
            log,
            preset=preset,
            store=store,
            chunks=wanted,
            config=effective.model_dump(mode="json"),
            budget_s=budget_s,
            began=began,
            table=given,
        )
    if as_json:
        shown = ("log", "preset", "store", "run", "chunks", "budget")
        typer.echo(json.dumps({key: summary[key] for key in shown if key in summary}))
    else:
        print_run(summary)


def _chosen(
    log: str,
    preset: str,
    chunks: list[int] | None,
    config: PipelineConfig,
    budget_s: float,
    began: float,
    table: str | None,
) -> tuple[PipelineConfig, str]:
    """What a budget would begin the first chunk with, and the stage where that ends; said on stderr."""
    from flows.budget.budget import Budget
    from flows.pipeline.log_cache import chosen_chunks

    budget, wanted = Budget(budget_s, began, table, preset, config), chosen_chunks(log, config, chunks)
    typer.echo(budget.told(), err=True)
    chooser = budget.chooser(log, wanted[0])
    chooser.calibrate()  # nothing else is starting
    step = chooser.next(1 / len(wanted))
    typer.echo(f"chunk {wanted[0]}: {chooser.choices[0]} (Prefect's start would be counted, too)", err=True)
    return config if step is None else step[1], str(chooser.record()["end"])


def _dry_run(
    log: str, preset: str, store: str, chunks: list[int] | None, config: PipelineConfig, end: str, as_json: bool
) -> None:
    from flows.cli.terminal import print_plan
    from flows.configuration import differences
    from flows.pipeline.prediction import plan_run

    plan: dict[str, Any] = plan_run(log, store, chunks, config, end)
    plan |= {"preset": preset, "differs": {k: list(v) for k, v in differences(config, preset).items()}}
    if as_json:
        typer.echo(json.dumps(plan))
    else:
        print_plan(plan)
