"""``genre gc``: removes what no run and no pin of a store refers to."""

from __future__ import annotations

from typing import Annotated

import typer

from flows.cli.options import JsonOption, StoreOption
from flows.defaults import DEFAULT_STORE


def gc(
    store: StoreOption = DEFAULT_STORE,
    delete: Annotated[
        bool, typer.Option("--delete", help="Remove what is listed. Without it nothing changes.")
    ] = False,
    older_than: Annotated[
        float, typer.Option(min=0.0, help="How many hours ago something was made, at least, that may go.")
    ] = 24.0,
    as_json: JsonOption = False,
) -> None:
    """Remove what no run and no pin of a store refers to.

    It lists what would go; --delete removes it. What a run, a pin or an imported scene was made from stays. Best
    let no run of this store be under way: it has no record yet, and may read what it found in the store.

    Example:

    \b
        genre gc --store genre-store
        genre gc --store genre-store --delete
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.outcome import print_outcome
    from flows.cli.printing import print_rows
    from flows.upkeep.garbage import find_garbage, measure_bytes

    opened = open_existing_store(store)
    garbage = find_garbage(opened, min_age_s=3600.0 * older_than)
    by_stage: dict[str, list[int]] = {}
    for artifact in garbage.artifacts:
        counts = by_stage.setdefault(artifact.address.stage, [0, 0])
        counts[0] += 1
        counts[1] += measure_bytes([artifact])
        if delete:
            opened.discard(artifact)
    leftovers = opened.clean_temporaries(3600.0 * older_than, everywhere=True) if delete else 0
    rows = [
        {"stage": stage, "artifacts": count, "MB": round(size / 1e6, 1)} for stage, (count, size) in by_stage.items()
    ]
    size = measure_bytes(garbage.artifacts)
    facts = {"deleted": delete, "bytes": size, "kept": garbage.kept, "young": garbage.young, "leftovers": leftovers}
    if as_json:
        addresses = [str(artifact.address) for artifact in garbage.artifacts]
        print_outcome("done", {**facts, "artifacts": addresses})
        return
    if rows:
        print_rows("removed" if delete else "would go", rows)
    verb = "were removed" if delete else "would go"
    typer.echo(f"{len(garbage.artifacts)} artifacts of {size / 1e6:.1f} MB {verb}; {garbage.kept} are referred to")
    if garbage.young:
        typer.echo(f"{garbage.young} more are younger than {older_than:g} hours and stay")
    if leftovers:
        typer.echo(f"{leftovers} leftovers of killed processes were removed")
    if rows and not delete:
        typer.echo("Nothing was changed. Add --delete to remove them.")
