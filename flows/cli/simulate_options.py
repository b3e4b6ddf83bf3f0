"""The options of ``genre simulate``, and the request that they make."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer

from flows.cli.edit_options import read_edits
from flows.cli.parsing import parse_numbers, parse_path

if TYPE_CHECKING:
    from flows.simulation.request import SimulationRequest

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
StrengthOption = Annotated[float, typer.Option(help="How strong the behaviour is; 1 is the configured strength.")]
DelayOption = Annotated[float, typer.Option(help="Seconds of recorded driving before the behaviour starts.")]
SideOption = Annotated[
    str | None, typer.Option(help="left or right, for lane-change and swerve. The recorded path's side otherwise.")
]
CamerasOption = Annotated[
    str | None, typer.Option(help="Names of the cameras, separated by commas. All cameras if not given.")
]
SensorsOption = Annotated[
    str,
    typer.Option(
        help="What is simulated, separated by commas: rgb, depth, masks (instances and classes), flow (optical, to "
        "the next pose) and lidar (sweeps of the log's sensor)."
    ),
]
FixOption = Annotated[
    bool, typer.Option("--fix", help="Repair all images by FNet. What removed actors hid is filled by it anyway.")
]
ExrOption = Annotated[
    bool, typer.Option("--exr", help="Also write scene-linear images with opacity and depth: CAMERA/000012.exr.")
]
PngOption = Annotated[bool, typer.Option("--png", help="Also write images as CAMERA/000012.png.")]
AllowCollisionOption = Annotated[
    bool, typer.Option("--allow-collision", help="Render a path that meets other road users all the same.")
]
AllowImplausibleOption = Annotated[
    bool, typer.Option("--allow-implausible", help="Render a path that no vehicle can drive all the same.")
]
NoRangeOption = Annotated[
    bool,
    typer.Option(
        "--no-range", help="Do not mark poses outside of the reliable range. It takes a minute once for each scene."
    ),
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace another simulation in the folder; never any other files.")
]


def read_request(options: Mapping[str, Any]) -> SimulationRequest:
    """Makes a request of the options of ``genre simulate``.

    Args:
        options: values by the names of the command's parameters.

    Returns:
        The request, checked as far as it can be without the run.

    Raises:
        ConfigError: an option cannot be read, or two of them do not go together.
    """
    from flows.simulation.request import SimulationRequest

    numbers = parse_numbers(options["chunks"], "--chunks")
    shorthands = ("remove", "insert", "move", "retime", "rotate", "scale_speed")
    # What has the same name and meaning in both.
    same = ("store", "run", "out", "stage", "behaviour", "strength", "fix", "exr", "png", "overwrite")
    request = SimulationRequest(
        **{name: options[name] for name in (*same, "allow_collision", "allow_implausible")},
        chunks=None if numbers is None else tuple(numbers),
        path_file=options["path"],
        start_offset_m=_parse_offset(options["start_offset"]),
        delay_s=options["delay"],
        side=_parse_side(options["side"]),
        cameras=None if options["cameras"] is None else _split(options["cameras"]),
        edits=read_edits(options["edits"], **{name: options[name] for name in shorthands}),
        sensors=_split(options["sensors"]),
        mark_range=not options["no_range"],
        settings=tuple(options["settings"] or ()),
    )
    request.check()
    return request


def _split(text: str) -> tuple[str, ...]:
    # A name that is there twice counts once.
    return tuple(dict.fromkeys(name.strip() for name in text.split(",")))


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
