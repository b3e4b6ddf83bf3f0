"""``genre lineage``: what made an artifact, what was made from it, and what a change would compute again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.options import JsonOption, StoreOption
from flows.defaults import DEFAULT_STORE

if TYPE_CHECKING:
    from storage.store import Artifact, Store


def lineage(
    name: Annotated[str, typer.Argument(help="The key of an artifact or the name of a run, or the first characters.")],
    change: Annotated[
        str | None,
        typer.Option(
            "--if",
            help="What changes: a setting as gnet.iterations=96, code:MODULE, weights:NETWORK, package:NAME, or log.",
        ),
    ] = None,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """Show what made an artifact, or what a change would compute again.

    With --if it lists the stages of a run that would be computed again, with the seconds that they took. It decides by
    the same keys as a run does.

    Example:

    \b
        genre lineage 5f41c0de
        genre lineage 5f41c0de --if gnet.iterations=96
        genre lineage 5f41c0de --if weights:fnet
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.outcome import print_outcome
    from flows.cli.printing import print_rows
    from flows.reconstruction.named_results import NamedRun, find_named

    opened = open_existing_store(store)
    found = find_named(opened, name)
    if change is not None:
        record = found.record if isinstance(found, NamedRun) else _find_run_of(opened, found)
        _print_recomputations({**record, "store": opened.uri}, change, as_json)
        return
    if isinstance(found, NamedRun):
        facts = {"run": found.record["run"], "chunks": found.record["chunks"]}
        rows = [
            {
                "chunk": chunk["chunk"],
                "stage": stage["stage"],
                "key": stage["key"][:12],
                "s": round(stage["seconds"], 1),
            }
            for chunk in found.record["chunks"]
            for stage in chunk["stages"]
        ]
        tables: dict[str, list[dict[str, Any]]] = {f"run {found.record['run']}": rows}
    else:
        from storage.lineage import find_ancestors, find_descendants

        tables = {
            "artifact": [_describe(found)],
            "made from": [_describe(artifact) for artifact in find_ancestors(opened, found)],
            "went into": [_describe(artifact) for artifact in find_descendants(opened, found)],
        }
        facts = {title.replace(" ", "_"): rows for title, rows in tables.items()}
    if as_json:
        print_outcome("done", facts)
        return
    for title, rows in tables.items():
        if rows:
            print_rows(title, rows)


def _find_run_of(store: Store, artifact: Artifact) -> dict[str, Any]:
    from flows.reconstruction.run_records import list_runs
    from flows.upkeep.pins import list_run_keys
    from genre_tasks.errors import InputError

    key = artifact.manifest.key
    found = [record for record in list_runs(store.uri) if key in list_run_keys(record)]
    if not found:
        raise InputError("no run of this store has this artifact", remedy="Name a run of `genre show runs`.", file=key)
    return found[-1]


def _print_recomputations(record: dict[str, Any], change: str, as_json: bool) -> None:
    from dataclasses import asdict

    from flows.cli.outcome import print_outcome
    from flows.cli.printing import print_rows
    from flows.upkeep.what_if import find_recomputations

    found = find_recomputations(record, change)
    seconds = sum(entry.seconds for entry in found)
    if as_json:
        print_outcome("done", {"run": record["run"], "seconds": seconds, "stages": [asdict(entry) for entry in found]})
        return
    if not found:
        typer.echo(f"nothing of run {record['run']} would be computed again")
        return
    rows = [
        {"chunk": entry.chunk, "stage": entry.stage, "s": round(entry.seconds, 1), "why": entry.reason}
        for entry in found
    ]
    print_rows(f"run {record['run']}: computed again", rows)
    typer.echo(f"{len(found)} stages, which took {seconds:.0f} s")


def _describe(artifact: Artifact) -> dict[str, Any]:
    manifest = artifact.manifest
    return {
        "stage": manifest.stage,
        "key": manifest.key[:12],
        "s": round(manifest.seconds, 1),
        "made_at": manifest.created_at[:16].replace("T", " "),
        "code": manifest.code_digest[:8],
        "weights": (manifest.weights_digest or "")[:8],
        "reads": ", ".join(manifest.inputs),
    }
