"""``genre cost``: what each knob buys, and what it costs in time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.options import ChunksOption, DryRunOption, LogsArgument, PresetOption, SettingsOption, StoreOption
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_STORE

CostFolderOption = Annotated[
    Path,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="The folder for cost.parquet, cost.png and cost.md; those that are there are replaced.",
    ),
]


def cost(
    logs: LogsArgument,
    preset: PresetOption = "small",
    knobs: Annotated[
        str | None,
        typer.Option(help="The knobs to turn, separated by commas, such as gnet_iterations,fixer. All if not given."),
    ] = None,
    seeds: Annotated[
        str, typer.Option(help="Seeds of the order of views and of the fixer's noise, separated by commas.")
    ] = "0,1,2",
    chunks: ChunksOption = None,
    settings: SettingsOption = None,
    store: StoreOption = DEFAULT_STORE,
    out: CostFolderOption = Path("cost"),
    dry_run: DryRunOption = False,
) -> None:
    """Measure what each setting gains and what it costs in time.

    The knobs of a run, such as iterations or the images' size, are turned one at a time and in a few combinations. The
    result is a table, a picture and a page of accuracy against seconds. `genre run --budget` chooses from the table.

    Finished stages come from the store, so a sweep that was stopped goes on where it was.

    Example:

    \b
        genre cost 'synthetic:street?seed=1000' --knobs gnet_iterations --seeds 0 --out cost
    """
    from flows.cli.output_paths import check_output_folder
    from flows.cli.parsing import parse_numbers
    from flows.cli.printing import print_rows
    from flows.configuration.absolute_paths import make_setting_absolute
    from flows.cost_sweep.cell import Sweep, predict_cells
    from flows.cost_sweep.request import SweepRequest

    check_output_folder(out, "--out", ("cost.parquet", "cost_cells.parquet", "cost.png", "cost.md"))
    chunk_numbers = parse_numbers(chunks, "--chunks")
    seed_numbers = parse_numbers(seeds, "--seeds")
    knob_names = None if knobs is None else [name.strip() for name in knobs.split(",")]
    # The table names them, and a budget compares them with those of a run, whose paths are absolute.
    sweep = Sweep(preset, tuple(map(make_setting_absolute, settings or ())), store)
    # Mistakes in the request show here, before Prefect's server takes seconds to start.
    cells = SweepRequest(sweep, logs, chunk_numbers, seed_numbers, knob_names).cells()
    if dry_run:
        rows = predict_cells(sweep, cells)
        print_rows(f"{len(rows)} cells, {sum(row['seconds'] for row in rows) / 60:.0f} minutes", rows)
        return
    from flows.cli.terminal import report_on_terminal
    from flows.cost_sweep.flow import cost_of_accuracy

    # The sweep is a flow: Prefect shows its cells, and a cell that fails is left out and named.
    with report_on_terminal():
        done = cost_of_accuracy(
            logs,
            preset=preset,
            store=store,
            chunks=chunk_numbers,
            seeds=seed_numbers,
            knobs=knob_names,
            settings=list(sweep.settings),
            out=str(out),
        )
    typer.echo(f"{done['cells']} cells, {len(done['failed'])} left out; wrote {', '.join(done['files'])}")
    if done["failed"]:
        raise typer.Exit(1)
