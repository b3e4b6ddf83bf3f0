"""``genre pin`` and ``genre unpin``: runs and artifacts that ``genre gc`` leaves in a store."""

from __future__ import annotations

from typing import Annotated

import typer

from flows.cli.options import StoreOption
from flows.defaults import DEFAULT_STORE

NameArgument = Annotated[
    str | None, typer.Argument(help="The name of a run, the key of an artifact, or the first characters of either.")
]


def pin(
    name: NameArgument = None,
    note: Annotated[str, typer.Option(help="Why it is kept.")] = "",
    list_all: Annotated[bool, typer.Option("--list", help="List the pins of the store instead.")] = False,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Keep a run or an artifact where `genre gc` would remove it.

    Example:

    \b
        genre pin 5f41c0de --note 'picture of the paper'
        genre pin --list
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.printing import print_rows
    from flows.upkeep.pins import add_pin, list_pins
    from genre_tasks.errors import ConfigError

    if (name is None) != list_all:
        raise ConfigError("give a run or a key, or --list", remedy="`genre show runs` lists the runs.")
    if list_all and note:
        raise ConfigError("--list has no use for --note", remedy="Leave it out, or give a run or a key to pin.")
    opened = open_existing_store(store)
    if name is None:
        rows = [
            {"pin": p.name, "artifacts": len(p.keys), "since": p.pinned_at, "note": p.note} for p in list_pins(opened)
        ]
        print_rows("pins", rows)
        return
    added = add_pin(opened, name, note)
    typer.echo(f"pinned {added.name}: {len(added.keys)} artifacts, and what they were made from")


def unpin(
    name: Annotated[str, typer.Argument(help="The pin's name, or its first characters.")],
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Take a pin away, so that `genre gc` may remove what it kept.

    Example:

    \b
        genre unpin 5f41c0de
    """
    from flows.cli.existing_store import open_existing_store
    from flows.upkeep.pins import remove_pin

    removed = remove_pin(open_existing_store(store), name)
    typer.echo(f"no longer pinned: {removed.name}")
