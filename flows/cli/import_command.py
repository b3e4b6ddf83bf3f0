"""``genre import``: scenes from files of other people's tools into a store."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from flows.cli.options import JsonOption, StoreOption
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_STORE


def import_command(
    path: Annotated[
        Path,
        typer.Argument(
            parser=parse_path,
            metavar="PATH",
            help="A file (.ply, .splat, .spz, .glb, .usdz, .usdc, .usda), or a folder that `genre export` wrote.",
        ),
    ],
    name: Annotated[
        str | None, typer.Option(help="What the scene is called in the store. The file's name if not given.")
    ] = None,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """Read a scene of Gaussians from files and keep it in a store.

    The command prints what is in the file, what of it is not read, and what looks wrong. `genre show KEY` and
    `genre export NAME` find the scene again. A file without axes is taken to have z up and metres.

    Example:

    \b
        genre import street.ply
        genre import nodes --name street
        genre import scan.usdz --store scenes
    """
    from flows.cli.outcome import add_facts
    from flows.cli.terminal import TerminalReporter

    add_facts(file=str(path), store=store)
    with TerminalReporter("importing") as reporter:
        # Loading torch takes seconds.
        from flows.exchange.import_scene import import_scene

        record = import_scene(store, path, name, reporter.progress)
    _print_record(record, as_json)


def _print_record(record: Mapping[str, Any], as_json: bool) -> None:
    from flows.cli.outcome import print_outcome
    from flows.cli.printing import print_rows

    if as_json:
        print_outcome("done", record)
        return
    for chunk in record["chunks"]:
        print_rows(f"{record['name']}, chunk {chunk['chunk']}", [_node_row(node) for node in chunk["nodes"]])
        for loss in chunk["losses"]:
            typer.echo(f"not read: {loss}")
        for warning in chunk["warnings"]:
            typer.echo(f"warning: {warning}")
        typer.echo(f"kept as {record['name']}, chunk {chunk['chunk']}, key {chunk['key'][:12]}")


def _node_row(node: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "node": node["name"],
        "moves": "yes" if node["moves"] else "no",
        "Gaussians": node["gaussians"],
        "extent m": " x ".join(f"{side:.4g}" for side in node["extent_m"]),
        "harmonics": node["sh_degree"],
        "opacity": " to ".join(f"{value:.2g}" for value in node["opacity"]),
        "scale m": " to ".join(f"{value:.2g}" for value in node["scale_m"]),
    }
