"""``genre table``: a table of the paper, measured here, with the paper's numbers beside."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def table(
    number: Annotated[
        int,
        typer.Argument(help="1 comparison, 2 plug-in, 3 fixers by input, 4 ablation, 5 runtime by phase."),
    ],
    logs: Annotated[
        list[str], typer.Argument(help="Logs of one dataset: pandaset:PATH/002, pandaset:PATH/*, synthetic:…")
    ],
    preset: Annotated[str, typer.Option(help="demo, small, fine, long or paper.")] = "small",
    chunks: Annotated[str | None, typer.Option(help="Which chunks of each log, e.g. 0; all without it.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="section.key=value over the preset, for every method.")
    ] = None,
    methods: Annotated[
        list[Path] | None,
        typer.Option("--method", help="A YAML file of a method of your own: name, settings, end, note."),
    ] = None,
    weights: Annotated[
        list[str] | None,
        typer.Option(help="NAME=PATH of weights that do not ship: difix, streetcrafter (fixers), enet-g3r."),
    ] = None,
    store: Annotated[str, typer.Option(help="Where stages are kept and found again.")] = "genre-store",
    out: Annotated[Path, typer.Option(help="A folder for tableN_DATASET.md and .parquet.")] = Path("tables"),
    into: Annotated[
        Path | None, typer.Option(help="A Markdown page of several tables; this one's section is written anew.")
    ] = None,
    remarks: Annotated[
        list[str] | None, typer.Option("--remark", help="What else the reader should know, into the page.")
    ] = None,
    stored: Annotated[
        bool, typer.Option("--stored", help="Compute nothing: leave out the methods that the store has not whole.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say which cells would run, and what they would take.")
    ] = False,
) -> None:
    """Measure a table of the paper: every method on every chunk by the paper's protocol, its numbers beside.

    Finished stages come from the store, so a table that was stopped goes on where it was, and tables share stages.
    """
    from flows.cli.parsing import numbers
    from flows.cli.printing import print_rows
    from flows.paper_tables.flow import paper_table
    from flows.paper_tables.prediction import predicted
    from flows.paper_tables.request import Request

    chosen = numbers(chunks, "--chunks")
    files = [str(f) for f in methods or ()]
    request = Request(
        number,
        tuple(logs),
        preset,
        store,
        None if chosen is None else tuple(chosen),
        tuple(settings or ()),
        tuple(files),
        tuple(weights or ()),
        str(out),
        None if into is None else str(into),
        tuple(remarks or ()),
        stored,
    )
    plan = request.planned()  # what is wrong is said before a server is started
    if dry_run:
        rows = predicted(plan)
        print_rows(f"{len(rows)} cells, {sum(r['seconds'] for r in rows) / 60:.0f} minutes", rows)
        return
    from flows.cli.terminal import reporting

    with reporting():
        done = paper_table(
            number,
            logs,
            preset=preset,
            store=store,
            chunks=chosen,
            settings=settings,
            methods=files,
            weights=weights,
            out=str(out),
            into=request.into,
            remarks=remarks,
            stored=stored,
        )
    typer.echo(f"{done['cells']} cells, {len(done['failed'])} left out; wrote {', '.join(done['files'])}")
