"""``genre export``: the scenes of a run in files of other people's tools."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from flows.cli.options import ChunksOption, JsonOption, SceneStageOption, StoreOption
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_STORE

SceneArgument = Annotated[
    str,
    typer.Argument(
        metavar="RUN",
        help="The name of a finished run or of an imported scene, or its first characters. `genre show runs` lists "
        "runs.",
    ),
]
FormatOption = Annotated[
    str, typer.Option("--format", help="The format of the files: ply, splat, spz, glb, usdz or alpasim.")
]
FolderOption = Annotated[
    Path, typer.Option(parser=parse_path, metavar="FOLDER", help="The folder to write. It is made if missing.")
]
FrameOption = Annotated[int | None, typer.Option(help="Write one file: the scene as it is at this frame of the log.")]
AllFramesOption = Annotated[
    bool, typer.Option("--all-frames", help="Write a file for each frame, with the scene as it is then.")
]
PerActorOption = Annotated[
    bool, typer.Option("--per-actor", help="Write the actors alone, each in a file and in its own coordinates.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an export that is in the folder already.")]


def export(
    scene: SceneArgument,
    file_format: FormatOption,
    out: FolderOption,
    stage: SceneStageOption = None,
    chunks: ChunksOption = None,
    frame: FrameOption = None,
    all_frames: AllFramesOption = False,
    per_actor: PerActorOption = False,
    overwrite: OverwriteOption = False,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """Write a run's scenes in files for viewers, engines and editors.

    Formats that hold moving parts (glb, usdz) get one file for each chunk. Others (ply, splat, spz) get one file for
    each node: the background, the distant shell and each actor in its own coordinates. In both cases scene.json says
    what the files do not: names, sizes, motions, times, the place in the world, and what was lost.

    Example:

    \b
        genre export 4b1c --format usdz --out street
        genre export 4b1c --format spz --per-actor --out cars
        genre export 4b1c --format alpasim --out bundle
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.outcome import add_facts
    from flows.cli.output_paths import check_new_folder
    from flows.cli.parsing import parse_numbers
    from flows.cli.terminal import TerminalReporter
    from flows.exchange.export_request import ExportRequest

    add_facts(run=scene, store=store, out=str(out), format=file_format)
    check_new_folder(out, "--out")
    open_existing_store(store)
    numbers = parse_numbers(chunks, "--chunks")
    request = ExportRequest(
        store=store,
        scene=scene,
        format=file_format,
        out=out,
        stage=stage,
        chunks=None if numbers is None else tuple(numbers),
        frame=frame,
        all_frames=all_frames,
        per_actor=per_actor,
        overwrite=overwrite,
    )
    with TerminalReporter("exporting") as reporter:
        from flows.exchange.export_scenes import export_scenes

        record = export_scenes(request, reporter.progress)
    _print_record(record, as_json)


def _print_record(record: Mapping[str, Any], as_json: bool) -> None:
    from flows.cli.outcome import print_outcome

    if as_json:
        print_outcome("done", record)
        return
    count = len(record["files"])
    files = f"{count} {record['format']} {'file' if count == 1 else 'files'}"
    size = f"{record['bytes'] / 2**20:.1f} MiB"
    typer.echo(f"wrote {record['out']}: {record['gaussians']} Gaussians, {files}, {size}")
    if record["losses"]:
        typer.echo("not in the files:")
    for loss in record["losses"]:
        typer.echo(f"  {loss}")
