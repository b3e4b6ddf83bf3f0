"""``genre simulate``: what the cameras of a finished run see when the vehicle drives otherwise."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import typer

from flows.cli.options import ChunksOption, JsonOption, RunArgument, SceneStageOption, SettingsOption, StoreOption
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_STORE

BehaviourOption = Annotated[
    str | None,
    typer.Option(
        help="How the vehicle drives: brake, accelerate, lane-change, swerve or recorded. As recorded, without an "
        "offset, if neither this nor --path is given."
    ),
]
OutOption = Annotated[
    Path,
    typer.Option(parser=parse_path, metavar="PATH", help="The folder to write, a new or empty one."),
]
PathFileOption = Annotated[
    Path | None,
    typer.Option(
        "--path",
        parser=parse_path,
        metavar="PATH",
        help="A Parquet or JSON file with the vehicle's poses, in place of a behaviour; the poses.parquet of another "
        "simulation is one.",
    ),
]
StartOffsetOption = Annotated[
    str | None,
    typer.Option(
        help="Where a behaviour starts: metres to the left of the recorded path, such as 3m or -1.5m. As in "
        "simulate.start_offset_m if not given."
    ),
]
EditsOption = Annotated[
    Path | None,
    typer.Option(parser=parse_path, metavar="PATH", help="A YAML file with a list `edits` of the traffic."),
]
ListOption = list[str] | None


def simulate(
    run: RunArgument,
    out: OutOption,
    behaviour: BehaviourOption = None,
    path: PathFileOption = None,
    start_offset: StartOffsetOption = None,
    strength: Annotated[float, typer.Option(help="How strong the behaviour is; 1 is the configured strength.")] = 1.0,
    delay: Annotated[float, typer.Option(help="Seconds of recorded driving before the behaviour starts.")] = 0.0,
    side: Annotated[
        str | None, typer.Option(help="left or right, for lane-change and swerve. The recorded path's side otherwise.")
    ] = None,
    cameras: Annotated[
        str | None, typer.Option(help="Names of the cameras, separated by commas. All cameras if not given.")
    ] = None,
    chunks: ChunksOption = None,
    stage: SceneStageOption = None,
    edits: EditsOption = None,
    remove: Annotated[
        ListOption, typer.Option(help="Remove an actor, such as car-12. May be given several times.")
    ] = None,
    insert: Annotated[
        ListOption,
        typer.Option(
            help="Insert an actor of this run or another one: [NAME@][RUN:]ACTOR,ahead=12,left=-3,turn=180,speed=5."
        ),
    ] = None,
    move: Annotated[ListOption, typer.Option(help="Move an actor, in metres: car-3,forward=2,left=-1.")] = None,
    retime: Annotated[ListOption, typer.Option(help="Let an actor drive later, in seconds: car-3,delay=0.5.")] = None,
    rotate: Annotated[ListOption, typer.Option(help="Turn an actor, in degrees: car-3,degrees=90.")] = None,
    scale_speed: Annotated[ListOption, typer.Option(help="Scale an actor's speed: car-3,factor=0.5.")] = None,
    sensors: Annotated[
        str,
        typer.Option(
            help="What is simulated, separated by commas: rgb, depth, masks (instances and classes), flow (optical, to "
            "the next pose) and lidar (sweeps of the log's sensor)."
        ),
    ] = "rgb",
    fix: Annotated[
        bool, typer.Option("--fix", help="Repair all images by FNet. What removed actors hid is filled by it anyway.")
    ] = False,
    exr: Annotated[
        bool, typer.Option("--exr", help="Also write scene-linear images with opacity and depth: CAMERA/000012.exr.")
    ] = False,
    png: Annotated[bool, typer.Option("--png", help="Also write images as CAMERA/000012.png.")] = False,
    allow_collision: Annotated[
        bool, typer.Option("--allow-collision", help="Render a path that meets other road users all the same.")
    ] = False,
    allow_implausible: Annotated[
        bool, typer.Option("--allow-implausible", help="Render a path that no vehicle can drive all the same.")
    ] = False,
    no_range: Annotated[
        bool,
        typer.Option(
            "--no-range", help="Do not mark poses outside of the reliable range. It takes a minute once for each scene."
        ),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace another simulation in the folder; never any other files.")
    ] = False,
    settings: SettingsOption = None,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """Drive otherwise through a finished run, and film what its cameras see.

    The folder gets a film CAMERA.mp4 for each camera, poses.parquet with marks for each pose, metrics.json, and
    manifest.json with the simulation's key and the digests of all files. It is complete in itself and no part of the
    store. The same command finds it there, verifies it and renders nothing.

    Example:

    \b
        genre simulate 4b1c --behaviour brake --out braking
        genre simulate 4b1c --behaviour swerve --start-offset -1m --cameras front_camera --exr --out swerving
        genre simulate 4b1c --remove car-3 --move car-5,left=1.5 --out edited
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.outcome import add_facts
    from flows.cli.output_paths import check_output_folder
    from flows.cli.parsing import parse_numbers
    from flows.cli.terminal import TerminalReporter
    from flows.simulation.edit_file import parse_edit_options, read_edit_file
    from flows.simulation.request import SimulationRequest
    from genre_tasks.scene_edits.edits import EditList

    add_facts(run=run, store=store, out=str(out))
    check_output_folder(out, "--out")
    open_existing_store(store)
    numbers = parse_numbers(chunks, "--chunks")
    listed = EditList() if edits is None else read_edit_file(edits)
    request = SimulationRequest(
        store=store,
        run=run,
        out=out,
        stage=stage,
        chunks=None if numbers is None else tuple(numbers),
        behaviour=behaviour,
        path_file=path,
        start_offset_m=_parse_offset(start_offset),
        strength=strength,
        delay_s=delay,
        side=_parse_side(side),
        cameras=None if cameras is None else tuple(name.strip() for name in cameras.split(",")),
        edits=listed
        + parse_edit_options(remove or (), insert or (), move or (), retime or (), rotate or (), scale_speed or ()),
        sensors=tuple(dict.fromkeys(name.strip() for name in sensors.split(","))),
        fix=fix,
        allow_collision=allow_collision,
        allow_implausible=allow_implausible,
        mark_range=not no_range,
        settings=tuple(settings or ()),
        exr=exr,
        png=png,
        overwrite=overwrite,
    )
    request.check()
    with TerminalReporter("simulating") as reporter:
        # Loading torch takes seconds, in which a mistyped option would wait.
        from flows.simulation.simulate import simulate_run

        record = simulate_run(request, reporter.progress)
    _print_record(record, as_json)


def _parse_offset(text: str | None) -> float | None:
    if text is None:
        return None
    from genre_tasks.errors import ConfigError

    match = re.fullmatch(r"\s*([+-]?[0-9]{1,9}(?:\.[0-9]+)?)\s*m?\s*", text)
    if match is None:
        remedy = "Write metres to the left, such as 3m, or -1.5m for the right."
        raise ConfigError(f"cannot read --start-offset {text!r}", remedy=remedy)
    return float(match[1])


def _parse_side(text: str | None) -> Literal["left", "right"] | None:
    from genre_tasks.errors import ConfigError
    from genre_tasks.suggestions import did_you_mean

    if text is not None and text not in ("left", "right"):
        remedy = f"{did_you_mean(text, ('left', 'right'))}Write left or right."
        raise ConfigError(f"no side is called '{text}'", remedy=remedy)
    return cast(Literal["left", "right"] | None, text)


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
