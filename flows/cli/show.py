"""``genre show``: tables of runs, chunks and stages; one artifact's manifest, schema, statistics and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from storage.local import Artifact


def show(
    what: Annotated[
        str, typer.Argument(help="runs, stages, config, a run, or (the start of) an artifact's key.")
    ] = "runs",
    store: Annotated[str, typer.Option(help="The store to look into.")] = "genre-store",
    preset: Annotated[str, typer.Option(help="With `config`: whose values to show.")] = "small",
    picture: Annotated[Path | None, typer.Option(help="Write the artifact's picture to this PNG.")] = None,
) -> None:
    """Show what a store holds: `genre show`, `genre show stages`, `genre show RUN`, `genre show KEY`."""
    from flows.cli.printing import print_fields, print_rows

    if what == "config":
        from flows.configuration import load_configuration

        print_fields(f"preset {preset}", load_configuration(preset).model_dump())
    elif what == "runs":
        from flows.reconstruction.run_records import recorded_runs

        print_rows("runs", [_run_row(run) for run in recorded_runs(store)])
    elif what == "stages":
        from storage.local import open_store

        print_rows("artifacts", [_row(artifact) for artifact in open_store(store).artifacts()])
    else:
        _show_one(what, store, picture)


def _run_row(run: dict[str, Any]) -> dict[str, Any]:
    stages = [s for c in run["chunks"] for s in c["stages"]]
    return {
        "run": run["run"],
        "log": run["log"],
        "preset": run["preset"],
        "chunks": len(run["chunks"]),
        "computed": sum(not s["cached"] for s in stages),
        "seconds": sum(s["seconds"] for s in stages),
        "report": run["report"],
    }


def _row(artifact: Artifact) -> dict[str, Any]:
    m = artifact.manifest
    size = sum(f.size for f in m.files) / 2**20
    return {
        "log": m.log,
        "chunk": m.chunk,
        "stage": m.stage,
        "key": m.key[:12],
        "seconds": m.seconds,
        "peak MiB": m.peak_mib,
        "MiB": size,
        "made": m.created_at[:19],
    }


def _show_one(what: str, store: str, picture: Path | None) -> None:
    from flows.cli.printing import print_fields, print_rows
    from flows.reconstruction.run_records import recorded_runs
    from genre_tasks.errors import InputError
    from storage.local import open_store

    for run in recorded_runs(store):
        if run["run"].startswith(what):
            print_fields(f"run {run['run']}", {k: run[k] for k in ("log", "preset", "report", "differs", "config")})
            for chunk in run["chunks"]:
                rows = [
                    {"stage": s["stage"], "key": s["key"][:12], "seconds": s["seconds"], **s["metrics"]}
                    for s in chunk["stages"]
                ]
                for row in rows:
                    print_fields(f"chunk {chunk['chunk']}  {row.pop('stage')}", row)
            return
    opened = open_store(store)
    found = [a for a in opened.artifacts() if a.manifest.key.startswith(what)]
    if len(found) != 1:
        raise InputError(
            f"{len(found)} runs or artifacts begin with '{what}'",
            remedy="`genre show runs` and `genre show stages` list them; give more of the name.",
            file=store,
        )
    from flows.plots.artifact_pictures import draw_artifact
    from storage.lineage import ancestors, describe

    (artifact,) = found
    print_fields("manifest", artifact.manifest.model_dump(exclude={"files"}))
    print_rows("files", [f.model_dump() for f in artifact.manifest.files])
    for table in describe(opened, artifact):
        print_rows(table.name, table.rows)
    print_rows("made from", [_row(a) for a in ancestors(opened, artifact)])
    if picture is not None:
        image = draw_artifact(opened, artifact)
        if image is None:
            raise InputError(
                "this artifact has no picture", remedy="Leave out --picture.", stage=artifact.manifest.stage
            )
        from PIL import Image

        Image.fromarray(image).save(picture)
        typer.echo(f"wrote {picture}")
