"""``genre show``: tables of runs and stages; one run's metrics; one artifact's manifest, statistics and picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.options import PresetOption, StoreOption
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_PRESET, DEFAULT_STORE

if TYPE_CHECKING:
    from storage.local import LocalStore
    from storage.store import Artifact


def show(
    what: Annotated[
        str,
        typer.Argument(
            help="runs for all finished runs, stages for all artifacts, config for a preset's configuration, actors "
            "for a run's actors, the name of a run, or the key of an artifact. The first characters of a name or a key "
            "are enough."
        ),
    ] = "runs",
    run: Annotated[str | None, typer.Argument(help="The run whose actors are shown.")] = None,
    store: StoreOption = DEFAULT_STORE,
    preset: PresetOption = DEFAULT_PRESET,
    picture: Annotated[
        Path | None,
        typer.Option(
            parser=parse_path,
            metavar="PATH",
            help="Write the artifact's picture to this PNG file, over an existing one, or the pictures of all actors. "
            "`what` must be a key, or actors.",
        ),
    ] = None,
) -> None:
    """Show what a store holds: runs, stages, one run or one artifact.

    Without an argument the command lists the finished runs. For an artifact it prints the manifest, the files with
    statistics of their columns, and the artifacts that it was made from. `--preset` counts for `genre show config`.
    Names of actors are those that `genre edit` takes.

    Example:

    \b
        genre show
        genre show stages
        genre show config --preset fine
        genre show 4b1c
        genre show 9f02ab --picture artifact.png
        genre show actors 4b1c --picture actors.png
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.output_paths import check_output_file
    from flows.cli.printing import print_fields, print_rows

    if picture is not None:
        # The picture is a PNG under any name, and a PNG called x.jpg would not open everywhere.
        check_output_file(picture, "--picture", (".png",))
        if what in ("config", "runs", "stages"):
            raise _no_picture(f"a list of {what}" if what != "config" else "a configuration")
    if run is not None and what != "actors":
        raise _second_word(what, run)
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
        print_rows("artifacts", [_artifact_row(artifact) for artifact in opened.artifacts()])
    else:
        _show_run_or_artifact(what, opened, store, picture)


def _show_run_or_artifact(name: str, opened: LocalStore, store: str, picture: Path | None) -> None:
    from flows.reconstruction.run_records import list_runs
    from genre_tasks.errors import InputError

    # Names of runs and keys of artifacts are both hex digits. Runs are fewer and asked for more often.
    runs = list_runs(store, name)
    if len(runs) == 1 and name:
        if picture is not None:
            raise _no_picture("a run")
        _print_record(runs[0])
        return
    artifacts = [artifact for artifact in opened.artifacts() if artifact.manifest.key.startswith(name)]
    # Several may share the first digits; to guess which one is meant would show the wrong one.
    if runs or len(artifacts) != 1 or not name:
        raise InputError(
            f"{len(runs) + len(artifacts)} runs or artifacts begin with '{name}'",
            remedy="`genre show runs` and `genre show stages` list them; give more of the name.",
            file=store,
        )
    if picture is not None:
        # Before the tables, which would hide an error about the picture.
        _write_picture(opened, artifacts[0], picture)
    _print_artifact(opened, artifacts[0])
    if picture is not None:
        typer.echo(f"wrote {picture}")


def _second_word(what: str, run: str) -> Exception:
    from genre_tasks.errors import ConfigError

    return ConfigError(f"'{run}' after '{what}' has no meaning", remedy="Only `genre show actors` takes a second word.")


def _no_picture(what: str) -> Exception:
    from genre_tasks.errors import ConfigError

    return ConfigError(
        f"{what} has no picture", remedy="Give --picture with the key of an artifact; `genre show stages` lists them."
    )


def _print_record(record: dict[str, Any]) -> None:
    from flows.cli.printing import print_fields
    from flows.error_record import describe_record

    fields = {field: record[field] for field in ("log", "preset", "report", "differs", "config")}
    # Records of earlier versions do not have it.
    left_out = {f"chunk {entry['chunk']}": describe_record(entry) for entry in record.get("left_out", ())}
    print_fields(f"run {record['run']}", fields | ({"left_out": left_out} if left_out else {}))
    for chunk in record["chunks"]:
        for stage in chunk["stages"]:
            row = {"key": stage["key"][:12], "seconds": stage["seconds"], **stage["metrics"]}
            print_fields(f"chunk {chunk['chunk']}  {stage['stage']}", row)


def _print_artifact(store: LocalStore, artifact: Artifact) -> None:
    from flows.cli.printing import print_fields, print_rows
    from storage.lineage import find_ancestors, summarise_files

    print_fields("manifest", artifact.manifest.model_dump(exclude={"files"}))
    print_rows("files", [file.model_dump() for file in artifact.manifest.files])
    for table in summarise_files(store, artifact):
        print_rows(table.name, table.rows)
    print_rows("made from", [_artifact_row(ancestor) for ancestor in find_ancestors(store, artifact)])


def _write_picture(store: LocalStore, artifact: Artifact, path: Path) -> None:
    from flows.plots.artifact_pictures import draw_artifact
    from genre_tasks.atomic_path import atomic_path
    from genre_tasks.errors import InputError
    from storage.codecs.png import write_png

    image = draw_artifact(store, artifact)
    if image is None:
        raise InputError("this artifact has no picture", remedy="Leave out --picture.", stage=artifact.manifest.stage)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        write_png(part, image)


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


def _artifact_row(artifact: Artifact) -> dict[str, Any]:
    manifest = artifact.manifest
    return {
        "log": manifest.log,
        "chunk": manifest.chunk,
        "stage": manifest.stage,
        "key": manifest.key[:12],
        "seconds": manifest.seconds,
        "peak MiB": manifest.peak_mib,
        "MiB": sum(file.size for file in manifest.files) / 2**20,
        "made": manifest.created_at[:19],
    }
