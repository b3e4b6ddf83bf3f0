"""``genre verify``: does every artifact of a store still match its manifest?"""

from __future__ import annotations

from typing import Annotated

import typer


def verify(
    store: Annotated[str, typer.Option(help="The store to read through.")] = "genre-store",
) -> None:
    """Read every artifact of a store and compare it with its manifest; exit code 1 if any is damaged."""
    from genre_tasks.errors import InputError
    from storage.local import open_store

    opened, whole, damaged = open_store(store), 0, 0
    if not opened.root.is_dir():
        raise InputError("there is no store", remedy="Give the folder of one by --store.", file=opened.root)
    for _, error in opened.check():
        if error is None:
            whole += 1
        else:
            damaged += 1
            typer.echo(f"damaged: {error}")
    typer.echo(f"{whole} artifacts are whole, {damaged} damaged")
    if damaged:
        typer.echo("Run the log again: damaged artifacts are computed anew, nothing else is.")
        raise typer.Exit(1)
