"""``genre verify``: does every artifact of a store still match its manifest?"""

from __future__ import annotations

import typer

from flows.cli.options import StoreOption
from flows.defaults import DEFAULT_STORE


def verify(store: StoreOption = DEFAULT_STORE) -> None:
    """Check every artifact of a store against its manifest.

    Every file is read and compared with the size and the sha256 that its manifest lists. Damaged artifacts are named;
    nothing is changed. The exit status is 1 if any artifact is damaged.

    Example:

    \b
        genre verify --store genre-store
    """
    from flows.cli.existing_store import open_existing_store

    opened = open_existing_store(store)
    sound = 0
    damaged = 0
    for _, error in opened.verify_all():
        if error is None:
            sound += 1
        else:
            damaged += 1
            # All of them are listed, not the first alone: a failing disk seldom damages one file.
            typer.echo(f"damaged: {error}")
    typer.echo(f"{sound} artifacts are sound, {damaged} damaged")
    if damaged:
        typer.echo("Run the log again: damaged artifacts are computed again, nothing else is.")
        raise typer.Exit(1)
