"""``genre convert``: a log in another layout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.options import JsonOption

LogArgument = Annotated[str, typer.Argument(metavar="LOG", help="The log to read, such as kitti:PATH.")]
TargetArgument = Annotated[
    str, typer.Argument(metavar="TARGET", help="The layout and the folder to write: genre:FOLDER or pandaset:FOLDER.")
]


def convert(log: LogArgument, target: TargetArgument, as_json: JsonOption = False) -> None:
    """Write a log in the layout of GenRe or of PandaSet.

    Images keep their bytes, and what is missing stays missing. The folder appears complete or not at all.

    Example:

    \b
        genre convert kitti:2011_09_26/2011_09_26_drive_0009_sync genre:drive-9
    """
    from flows.cli.outcome import add_facts, print_outcome
    from flows.cli.output_paths import check_new_folder
    from flows.cli.terminal import TerminalReporter
    from genre_tasks.errors import ConfigError
    from genre_tasks.logs.genre_layout.writer import write_genre_layout
    from genre_tasks.logs.pandaset.writer import write_pandaset
    from genre_tasks.logs.registry import open_log
    from genre_tasks.logs.vehicle_center import find_center_ahead
    from genre_tasks.user_paths import expand_user_path

    add_facts(log=log, target=target)
    writers = {"genre": write_genre_layout, "pandaset": write_pandaset}
    layout, _, folder = target.partition(":")
    if layout not in writers or not folder:
        remedy = "Give the layout and a folder, as in genre:my-log or pandaset:007."
        raise ConfigError(f"{target!r} names no layout that can be written", remedy=remedy)
    goal = expand_user_path(folder)
    check_new_folder(goal, "the target")
    source = open_log(log)
    with TerminalReporter("reading the log") as reporter:
        written: Path = writers[layout](source, goal, reporter.progress)
    # The copy does not say it, so that whoever made it has to know.
    center_ahead_m = find_center_ahead(log)
    record = {
        "written": f"{layout}:{written}",
        "frames": source.frame_count,
        "cameras": len(source.cameras),
        "tracks": len(source.tracks()),
        "center_ahead_m": center_ahead_m,
    }
    if as_json:
        print_outcome("done", record)
        return
    counts = f"{record['frames']} frames, {record['cameras']} cameras, {record['tracks']} objects with boxes"
    typer.echo(f"wrote {record['written']}: {counts}")
    if center_ahead_m:
        typer.echo(
            f"The middle of the car is {center_ahead_m:g} m ahead of the vehicle's origin, and the copy does not say "
            f"so. Run it with --set simulate.center_ahead_m={center_ahead_m:g}."
        )
