"""``genre verify``: does every artifact of a store still match its manifest?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.options import StoreOption
from flows.defaults import DEFAULT_STORE

if TYPE_CHECKING:
    from collections.abc import Mapping

    from genre_tasks.errors import GenreError
    from storage.store import Store


def verify(
    store: StoreOption = DEFAULT_STORE,
    repair: Annotated[
        bool, typer.Option("--repair", help="Remove damaged artifacts, and compute those of runs again.")
    ] = False,
) -> None:
    """Check every artifact of a store against its manifest.

    Every file is read and compared with the size and the sha256 that its manifest lists. Damaged artifacts are named,
    and so are those that cannot be read or are of a newer version, which --repair leaves as they are. Without --repair
    nothing is changed. The exit status is 1 if any artifact is not sound after all.

    Example:

    \b
        genre verify --store genre-store
        genre verify --store genre-store --repair
    """
    from flows.cli.existing_store import open_existing_store

    opened = open_existing_store(store)
    sound = 0
    faults: dict[str, GenreError] = {}
    counts = dict.fromkeys(("damaged", "unreadable", "of a newer version"), 0)
    for name, error in opened.verify_all():
        if error is None:
            sound += 1
        else:
            faults[name] = error
            word = _name_fault(error)
            counts[word] += 1
            # All of them are listed, not the first alone: a failing disk seldom damages one file.
            typer.echo(f"{word}: {error}")
    found = [f"{count} {word}" for word, count in counts.items() if count or word == "damaged"]
    typer.echo(f"{sound} artifacts are sound, {', '.join(found)}")
    if not faults:
        return
    if not repair:
        if counts["damaged"]:
            typer.echo("Add --repair, or run the log again: damaged artifacts are computed again, nothing else is.")
        raise typer.Exit(1)
    if not _repair(opened, faults):
        raise typer.Exit(1)


def _name_fault(error: GenreError) -> str:
    from genre_tasks.errors import ArtifactCorruptError
    from storage.manifest import NewerSchemaError

    if isinstance(error, NewerSchemaError):
        return "of a newer version"
    return "damaged" if isinstance(error, ArtifactCorruptError) else "unreadable"


def _repair(store: Store, faults: Mapping[str, GenreError]) -> bool:
    """Repairs artifacts and prints what became of each; whether all were repaired."""
    from flows.cli.terminal import report_on_terminal
    from flows.upkeep.repair import repair_artifacts

    def run_again(record: Mapping[str, Any]) -> None:
        with report_on_terminal():
            from flows.reconstruction.flow import recompute_run

            recompute_run(store.uri, record["run"])

    is_complete = True
    for done in repair_artifacts(store, faults, run_again):
        is_complete &= done.outcome == "repaired"
        typer.echo(f"{done.outcome}: {done.name}{': ' if done.why else ''}{done.why}")
    return is_complete
