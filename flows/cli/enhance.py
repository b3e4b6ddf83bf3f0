"""``genre enhance``: a scene of any origin goes through novel views, FNet and ENet."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.options import ChunksOption, DryRunOption, JsonOption, PresetOption, SettingsOption, StoreOption
from flows.cli.parsing import parse_path
from flows.cli.run import RunRequest, check_request, print_dry_run, reconstruct
from flows.defaults import DEFAULT_STORE

SceneFileArgument = Annotated[
    Path, typer.Argument(parser=parse_path, metavar="SCENE", help="The file of Gaussians, such as a 3DGS PLY.")
]
CamerasOption = Annotated[
    Path,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="Camera poses in the scene's coordinates: a transforms.json of nerfstudio or instant-ngp, or the folder "
        "of a COLMAP model.",
    ),
]
ImagesOption = Annotated[
    Path | None,
    typer.Option(parser=parse_path, metavar="PATH", help="The folder of the images. Near the poses if not given."),
]
LidarOption = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="A PLY file with LiDAR points in the scene's coordinates. The scene's own depth if not given.",
    ),
]
UpOption = Annotated[
    str, typer.Option(help="Which way is up in the scene's axes, such as 0,0,1; auto finds it from the cameras.")
]
ScaleOption = Annotated[
    str | None,
    typer.Option(
        help="Metres a unit of the scene, such as 1; auto assumes that the cameras are 1.6 m above the ground. Must be "
        "given where there is no LiDAR."
    ),
]
ChunkFramesOption = Annotated[
    int | None, typer.Option(help="Frames of a chunk, each of which is enhanced by itself. The preset's if not given.")
]


def enhance(
    scene: SceneFileArgument,
    cameras: CamerasOption,
    images: ImagesOption = None,
    lidar: LidarOption = None,
    up: UpOption = "auto",
    scale: ScaleOption = None,
    chunk_frames: ChunkFramesOption = None,
    preset: PresetOption = "small",
    store: StoreOption = DEFAULT_STORE,
    chunks: ChunksOption = None,
    settings: SettingsOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Enhance a 3D Gaussian scene that any program made.

    The scene is rendered beside the path of its cameras, FNet repairs these views, and ENet distils them back. No
    driving log is needed: images and their poses are enough. The result is a run like any other, so that `genre show`,
    `genre render` and `genre range` work on it; its initial scene is the one that was given.

    What was found or assumed about axes, scale and depth is printed before the run.

    Example:

    \b
        genre enhance point_cloud.ply --cameras transforms.json --scale 1
        genre enhance point_cloud.ply --cameras colmap/sparse/0 --images images --scale auto
        genre enhance point_cloud.ply --cameras transforms.json --lidar points.ply --up 0,0,1
    """
    import psutil

    from flows.cli.outcome import add_facts
    from flows.cli.parsing import parse_numbers
    from flows.configuration import load_configuration
    from flows.enhancement.enhancement_request import EnhancementInputs, prepare_enhancement

    add_facts(scene=str(scene), preset=preset, store=store, run=None, report=None, chunks=[], left_out=[])
    inputs = EnhancementInputs(scene, cameras, images, lidar, up, scale, chunk_frames)
    prepared = prepare_enhancement(inputs, load_configuration(preset))
    add_facts(log=prepared.log)
    for line in prepared.explanation:
        # On stderr: with --json, stdout is the object alone.
        typer.echo(line, err=True)
    request = RunRequest(
        log=prepared.log,
        preset=preset,
        store=store,
        chunks=parse_numbers(chunks, "--chunks"),
        # The user's settings come last, and win.
        config=load_configuration(preset, settings=[*prepared.settings, *(settings or [])]),
        budget_s=None,
        start_time=psutil.Process().create_time(),
        table=None,
    )
    check_request(request)
    if dry_run:
        print_dry_run(request, as_json)
    else:
        reconstruct(request, as_json)
