"""``genre store copy``: a store, or some runs of it, into another store."""

from __future__ import annotations

from typing import Annotated

import typer

from flows.cli.options import JsonOption

_REPORT_EVERY = 10
app = typer.Typer(
    help="""Copy stores.

    Example:

    \b
        genre store copy genre-store s3://bucket/genre
    """,
    no_args_is_help=True,
)


# With a callback the one command is asked for by its name, as more may come.
@app.callback()
def _describe() -> None:
    pass


@app.command(name="copy")
def copy(
    source: Annotated[str, typer.Argument(metavar="FROM", help="The store to copy from: a folder or a URI.")],
    target: Annotated[str, typer.Argument(metavar="TO", help="The store to copy to. It is made if there is none.")],
    run: Annotated[
        list[str] | None, typer.Option(help="Copy this run alone, by its name or the start of it. May be given again.")
    ] = None,
    pinned: Annotated[bool, typer.Option("--pinned", help="Copy what is pinned alone.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Copy a store, or some of its runs, to another one.

    The copies have the same bytes, and every file is checked. What the target has already is left out, so the same
    command goes on where a copy was stopped. Records of runs, datasets and pins are copied last.

    Example:

    \b
        genre store copy genre-store s3://bucket/genre
        genre store copy s3://bucket/genre here --run 5f41c0de
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.outcome import print_outcome
    from flows.upkeep.store_copy import copy_store
    from genre_tasks.errors import ConfigError
    from storage.opening import open_store

    opened = open_existing_store(source)
    goal = open_store(target)
    if opened.uri == goal.uri:
        raise ConfigError("both stores are the same", remedy="Name another store to copy to.")
    goal.check_writable()

    def report(done: int, total: int, size: int) -> None:
        if done % _REPORT_EVERY == 0 and done:
            typer.echo(f"{done} of {total} artifacts, {size / 1e6:.1f} MB copied", err=True)

    result = copy_store(opened, goal, run or (), pinned, report)
    if as_json:
        print_outcome(
            "done",
            {
                "copied": result.copied,
                "skipped": result.skipped,
                "bytes": result.bytes_copied,
                "records": result.records,
            },
        )
        return
    typer.echo(
        f"copied {result.copied} artifacts of {result.bytes_copied / 1e6:.1f} MB and {result.records} records; "
        f"{result.skipped} artifacts were there"
    )
