"""``genre edit``: a finished run with other traffic, as a run of its own."""

from __future__ import annotations

import typer

from flows.cli.edit_options import (
    EditsOption,
    InsertOption,
    MoveOption,
    RemoveOption,
    RetimeOption,
    RotateOption,
    ScaleSpeedOption,
)
from flows.cli.options import RunArgument, StoreOption
from flows.defaults import DEFAULT_STORE


def edit(
    run: RunArgument,
    edits: EditsOption = None,
    remove: RemoveOption = None,
    insert: InsertOption = None,
    move: MoveOption = None,
    retime: RetimeOption = None,
    rotate: RotateOption = None,
    scale_speed: ScaleSpeedOption = None,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Edit the traffic of a finished run.

    Actors are removed, inserted, moved, delayed, turned, or get another speed.

    The edited scenes become a run with a name of its own, for `genre render`, `genre range` and `genre show`. The run
    that is edited stays as it is. `genre show actors RUN` shows the names of its actors.

    Actors stay on the ground and get a soft contact shadow, simulate.contact_shadow in the configuration. A cast shadow
    of the recording is part of the ground and stays there. What a removed actor hid is as the scene has it.

    Example:

    \b
        genre edit 4b1c --edits edits.yaml
        genre edit 4b1c --remove car-12 --move car-3,left=-1.5
        genre edit 4b1c --insert taxi@77aa:7,ahead=12,left=3.5,turn=180,speed=8
    """
    from flows.cli.edit_options import read_edits
    from flows.cli.existing_store import open_existing_store
    from flows.simulation.edited_runs import write_edited_run
    from genre_tasks.errors import ConfigError

    # Read first, because opening a run takes seconds.
    checked = read_edits(
        edits, remove=remove, insert=insert, move=move, retime=retime, rotate=rotate, scale_speed=scale_speed
    )
    if not len(checked):
        remedy = "Give --edits FILE, --remove, --insert, --move, --retime, --rotate or --scale-speed."
        raise ConfigError("there is nothing to edit", remedy=remedy)
    open_existing_store(store)
    record = write_edited_run(store, run, checked)
    for warning in record["edited"]["warnings"]:
        typer.echo(f"warning: {warning}")
    count = len(record["edited"]["edits"]["edits"])
    typer.echo(f"run {record['run']}: run {record['edited']['run']} with {count} edit{'s' if count != 1 else ''}")
    typer.echo(f"wrote {record['report']}")
