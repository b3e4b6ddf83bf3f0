"""``genre simulate``: what the cameras of a finished run see when the vehicle drives otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import typer

from flows.cli.edit_options import (
    EditsOption,
    InsertOption,
    MoveOption,
    RemoveOption,
    RetimeOption,
    RotateOption,
    ScaleSpeedOption,
)
from flows.cli.options import ChunksOption, JsonOption, RunArgument, SceneStageOption, SettingsOption, StoreOption
from flows.cli.simulate_options import (
    AllowCollisionOption,
    AllowImplausibleOption,
    BehaviourOption,
    CamerasOption,
    DelayOption,
    ExrOption,
    FixOption,
    NoRangeOption,
    OutOption,
    OverwriteOption,
    PathFileOption,
    PngOption,
    SensorsOption,
    SideOption,
    StartOffsetOption,
    StrengthOption,
    read_request,
)
from flows.defaults import DEFAULT_STORE


def simulate(
    run: RunArgument,
    out: OutOption,
    behaviour: BehaviourOption = None,
    path: PathFileOption = None,
    start_offset: StartOffsetOption = None,
    strength: StrengthOption = 1.0,
    delay: DelayOption = 0.0,
    side: SideOption = None,
    cameras: CamerasOption = None,
    chunks: ChunksOption = None,
    stage: SceneStageOption = None,
    edits: EditsOption = None,
    remove: RemoveOption = None,
    insert: InsertOption = None,
    move: MoveOption = None,
    retime: RetimeOption = None,
    rotate: RotateOption = None,
    scale_speed: ScaleSpeedOption = None,
    sensors: SensorsOption = "rgb",
    fix: FixOption = False,
    exr: ExrOption = False,
    png: PngOption = False,
    allow_collision: AllowCollisionOption = False,
    allow_implausible: AllowImplausibleOption = False,
    no_range: NoRangeOption = False,
    overwrite: OverwriteOption = False,
    settings: SettingsOption = None,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """Drive otherwise through a finished run and film what cameras see.

    The folder gets a film CAMERA.mp4 for each camera, poses.parquet with marks for each pose, metrics.json, and
    manifest.json with the simulation's key and the digests of all files. It is complete in itself and no part of the
    store. The same command finds it there, verifies it and renders nothing.

    Example:

    \b
        genre simulate 4b1c --behaviour brake --out braking
        genre simulate 4b1c --behaviour swerve --start-offset -1m --cameras front_camera --exr --out swerving
        genre simulate 4b1c --remove car-3 --move car-5,left=1.5 --out edited
    """
    # There are more options than this function has room for: they are read by name.
    options = dict(locals())
    _run(options)


def _run(options: Mapping[str, Any]) -> None:
    from flows.cli.existing_store import open_existing_store
    from flows.cli.outcome import add_facts
    from flows.cli.output_paths import check_new_folder
    from flows.cli.terminal import TerminalReporter

    add_facts(run=options["run"], store=options["store"], out=str(options["out"]))
    check_new_folder(options["out"], "--out")
    open_existing_store(options["store"])
    request = read_request(options)
    with TerminalReporter("simulating") as reporter:
        # Loading torch takes seconds, in which a mistyped option would wait.
        from flows.simulation.simulate import simulate_run

        record = simulate_run(request, reporter.progress)
    _print_record(record, options["as_json"])


def _print_record(record: Mapping[str, Any], as_json: bool) -> None:
    from flows.cli.outcome import print_outcome

    if as_json:
        print_outcome("done", record)
        return
    metrics = record["metrics"]
    for warning in record["warnings"]:
        typer.echo(f"warning: {warning}")
    for handover in metrics["handovers"]:
        if handover["seam_psnr_db"] is not None:
            frames = f"frames {handover['start_frame']:g} to {handover['end_frame']:g}"
            seam = f"both scenes agree to {handover['seam_psnr_db']:.1f} dB there"
            typer.echo(f"chunk {handover['before']} fades into chunk {handover['after']} over {frames}; {seam}")
    outcome = "found" if record["cached"] else "wrote"
    images = f"{metrics['poses']} images of {len(metrics['cameras'])} cameras"
    took = "from the cache" if record["cached"] else f"in {record['seconds']:.1f} s"
    typer.echo(f"{outcome} {record['out']}: {images}, {metrics['seconds_of_driving']:.1f} s of driving, {took}")
