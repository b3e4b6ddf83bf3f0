"""``genre show``: tables of runs and stages; one run's metrics; one artifact's manifest, statistics and picture."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.options import PresetOption, StoreOption
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_PRESET, DEFAULT_STORE

if TYPE_CHECKING:
    from storage.store import Store

WhatArgument = Annotated[
    str,
    typer.Argument(
        help="runs for all finished runs, stages for all artifacts, config for a preset's configuration, actors for a "
        "run's actors, the name of a run, the key of an artifact, or the path of a folder that `genre simulate` wrote. "
        "The first characters of a name or a key are enough."
    ),
]
PictureOption = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="Write the artifact's picture to this PNG file, over an existing one, or the pictures of all actors. "
        "`what` must be a key, or actors.",
    ),
]
_LISTS = ("runs", "stages", "config", "actors")


def show(
    what: WhatArgument = "runs",
    run: Annotated[str | None, typer.Argument(help="The run whose actors are shown.")] = None,
    store: StoreOption = DEFAULT_STORE,
    preset: PresetOption = DEFAULT_PRESET,
    chunk: Annotated[int | None, typer.Option(help="The chunk of a run. All chunks if not given.")] = None,
    picture: PictureOption = None,
) -> None:
    """Show what a store holds: runs, stages, one run or one artifact.

    Without an argument the command lists the finished runs. For an artifact it prints the manifest, what it holds, the
    files with statistics and histograms of their columns, and the artifacts that it was made from. `--preset` counts
    for `genre show config`. Names of actors are those that `genre edit` takes.

    Example:

    \b
        genre show
        genre show stages
        genre show config --preset fine
        genre show 4b1c --chunk 0
        genre show 9f02ab --picture artifact.png
        genre show actors 4b1c --picture actors.png
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.printing import print_fields, print_rows

    _check_options(what, run, preset, chunk, picture)
    if _is_folder(what):
        _show_folder(Path(what), chunk, picture)
        return
    if what == "config":
        from flows.configuration import load_configuration

        print_fields(f"preset {preset}", load_configuration(preset).model_dump())
        return
    opened = open_existing_store(store)
    if what == "actors":
        from flows.cli.show_actors import show_actors

        show_actors(store, run, picture)
    elif what == "runs":
        from flows.reconstruction.run_records import list_runs

        print_rows("runs", [_run_row(record) for record in list_runs(store)])
    elif what == "stages":
        from flows.cli.show_artifact import describe_artifact

        print_rows("artifacts", [describe_artifact(artifact) for artifact in opened.artifacts()])
    else:
        _show_run_or_artifact(what, opened, chunk, picture)


def _check_options(what: str, run: str | None, preset: str, chunk: int | None, picture: Path | None) -> None:
    from flows.cli.output_paths import check_output_file

    if picture is not None:
        # The picture is a PNG under any name, and a PNG called x.jpg would not open everywhere.
        check_output_file(picture, "--picture", (".png",))
        if what in _LISTS and what != "actors":
            raise _no_picture(f"a list of {what}" if what != "config" else "a configuration")
    if run is not None and what != "actors":
        raise _second_word(what, run)
    if preset != DEFAULT_PRESET and what != "config":
        raise _no_preset(what)
    if chunk is not None and what in _LISTS:
        raise _no_chunk(f"'{what}'")


def _show_run_or_artifact(name: str, opened: Store, chunk: int | None, picture: Path | None) -> None:
    from flows.cli.show_artifact import print_artifact, write_picture
    from flows.cli.show_run import print_run_record
    from flows.reconstruction.named_results import NamedRun, find_named

    found = find_named(opened, name)
    if isinstance(found, NamedRun):
        if picture is not None:
            raise _no_picture("a run")
        print_run_record(found.record, chunk)
        return
    if chunk is not None:
        raise _no_chunk("an artifact")
    if picture is not None:
        # Before the tables, which would hide an error about the picture.
        write_picture(opened, found, picture)
    print_artifact(opened, found)
    if picture is not None:
        typer.echo(f"wrote {picture}")


def _is_folder(what: str) -> bool:
    """A folder with a manifest, or any other that is written as a path: a key may be a folder's name, too."""
    # A name may be too long for the file system, which is then no folder.
    with contextlib.suppress(OSError):
        has_manifest = bool(what) and what not in _LISTS and (Path(what) / "manifest.json").is_file()
        return has_manifest or ("/" in what and Path(what).is_dir())
    return False


def _show_folder(folder: Path, chunk: int | None, picture: Path | None) -> None:
    from flows.cli.show_artifact import print_artifact, read_folder_artifact
    from storage.local import LocalStore

    if picture is not None:
        raise _no_picture("a folder outside of a store")
    if chunk is not None:
        raise _no_chunk("a folder outside of a store")
    # The folder stands alone: what it was made from is named in its manifest, and may be in any store.
    print_artifact(LocalStore(folder), read_folder_artifact(folder))


def _second_word(what: str, run: str) -> Exception:
    from genre_tasks.errors import ConfigError

    return ConfigError(f"'{run}' after '{what}' has no meaning", remedy="Only `genre show actors` takes a second word.")


def _no_preset(what: str) -> Exception:
    from genre_tasks.errors import ConfigError

    return ConfigError(f"--preset has no meaning for '{what}'", remedy="Only `genre show config` takes a preset.")


def _no_chunk(what: str) -> Exception:
    from genre_tasks.errors import ConfigError

    return ConfigError(
        f"--chunk has no meaning for {what}",
        remedy="Give --chunk with the name of a run; `genre show runs` lists them.",
    )


def _no_picture(what: str) -> Exception:
    from genre_tasks.errors import ConfigError

    return ConfigError(
        f"{what} has no picture", remedy="Give --picture with the key of an artifact; `genre show stages` lists them."
    )


def _run_row(record: dict[str, Any]) -> dict[str, Any]:
    stages = [stage for chunk in record["chunks"] for stage in chunk["stages"]]
    return {
        "run": record["run"],
        "log": record["log"],
        "preset": record["preset"],
        "chunks": len(record["chunks"]),
        "left out": len(record.get("left_out", ())),
        "computed": sum(not stage["cached"] for stage in stages),
        "seconds": sum(stage["seconds"] for stage in stages),
        "report": record["report"],
    }
