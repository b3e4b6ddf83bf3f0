"""``genre cost``: what each knob buys, and what it costs in time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def cost(
    logs: Annotated[
        list[str], typer.Argument(help="Logs: pandaset:PATH/002, pandaset:PATH/*, synthetic:street?seed=…")
    ],
    preset: Annotated[str, typer.Option(help="demo, small, fine, long or paper: where all knobs start.")] = "small",
    knobs: Annotated[str | None, typer.Option(help="Which, e.g. gnet_iterations,fixer; all without it.")] = None,
    seeds: Annotated[str, typer.Option(help="Of the order of views and the fixer's noise.")] = "0,1,2",
    chunks: Annotated[str | None, typer.Option(help="Which chunks of each log, e.g. 0; all without it.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="section.key=value over the preset, for every cell.")
    ] = None,
    store: Annotated[str, typer.Option(help="Where stages are kept and found again.")] = "genre-store",
    out: Annotated[Path, typer.Option(help="A folder for cost.parquet, cost.png and cost.md.")] = Path("cost"),
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say which cells would run, and what they would take.")
    ] = False,
) -> None:
    """Sweep the knobs of a run, one at a time and a few together: a table, a picture and a page of accuracy and time.

    Finished stages come from the store, so a sweep that was stopped goes on where it was.
    """
    from flows.cli.parsing import numbers
    from flows.cli.printing import print_rows
    from flows.cost_sweep.cell import Sweep
    from flows.cost_sweep.flow import cost_of_accuracy, planned
    from flows.cost_sweep.prediction import predicted

    chosen, order = numbers(chunks, "--chunks"), numbers(seeds, "--seeds")
    names = knobs.split(",") if knobs else None
    sweep = Sweep(preset, tuple(settings or ()), store)
    cells = planned(sweep, logs, chosen, order, names)  # what is wrong is said before a server is started
    if dry_run:
        rows = predicted(sweep, cells)
        print_rows(f"{len(rows)} cells, {sum(r['seconds'] for r in rows) / 60:.0f} minutes", rows)
        return
    from flows.cli.terminal import reporting

    with reporting():
        done = cost_of_accuracy(
            logs, preset=preset, store=store, chunks=chosen, seeds=order, knobs=names, settings=settings, out=str(out)
        )
    typer.echo(f"{done['cells']} cells, {len(done['failed'])} left out; wrote {', '.join(done['files'])}")
