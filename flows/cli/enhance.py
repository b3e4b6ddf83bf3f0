"""``genre enhance``: a scene of any origin goes through novel views, FNet and ENet."""

from __future__ import annotations

import typer

from flows.cli.options import ChunksOption, DryRunOption, JsonOption, PresetOption, SettingsOption, StoreOption
from flows.cli.run import RunRequest, check_request, print_dry_run, reconstruct
from flows.cli.scene_options import (
    CamerasOption,
    ChunkFramesOption,
    ImagesOption,
    LidarOption,
    ScaleOption,
    SceneFileArgument,
    UpOption,
)
from flows.defaults import DEFAULT_STORE


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
    from flows.configuration.absolute_paths import make_paths_absolute
    from flows.enhancement.enhancement_request import EnhancementInputs, prepare_enhancement
    from genre_tasks.logs.registry import make_log_absolute

    add_facts(scene=str(scene), preset=preset, store=store, run=None, report=None, chunks=[], left_out=[])
    inputs = EnhancementInputs(scene, cameras, images, lidar, up, scale, chunk_frames)
    prepared = prepare_enhancement(inputs, load_configuration(preset))
    # As of a run: the record names the log, and is read from other folders.
    log = make_log_absolute(prepared.log)
    add_facts(log=log)
    for line in prepared.explanation:
        # On stderr: with --json, stdout is the object alone.
        typer.echo(line, err=True)
    request = RunRequest(
        log=log,
        preset=preset,
        store=store,
        chunks=parse_numbers(chunks, "--chunks"),
        # The user's settings come last, and win.
        config=make_paths_absolute(load_configuration(preset, settings=[*prepared.settings, *(settings or [])])),
        budget_s=None,
        start_time=psutil.Process().create_time(),
        table=None,
    )
    check_request(request)
    if dry_run:
        print_dry_run(request, as_json)
    else:
        reconstruct(request, as_json)
