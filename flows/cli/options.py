"""Arguments and options that several commands share, with one help text each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.parsing import parse_path

# Typer shows a default after the help text. A default of None says nothing, so those texts say what None means.

LogArgument = Annotated[
    str,
    typer.Argument(
        help="The driving log: pandaset:FOLDER for a PandaSet sequence, such as pandaset:data/002, "
        "synthetic:street?seed=1000 for a made-up street, or a log of another layout, such as kitti:PATH."
    ),
]
_LOGS = typer.Argument(
    help="One or more driving logs, such as pandaset:data/002 or synthetic:street?seed=1000. 'pandaset:data/*' "
    "stands for every sequence in a folder, and 'nuscenes:data/@val.txt' for the names in a text file."
)
LogsArgument = Annotated[list[str], _LOGS]
OptionalLogsArgument = Annotated[list[str] | None, _LOGS]
PresetOption = Annotated[
    str, typer.Option(help="The named configuration to start from: demo, small, fine, long, hd or paper.")
]
SettingsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="Change one value of the configuration, as section.key=value, such as gnet.iterations=8. May be given "
        "several times.",
    ),
]
StoreOption = Annotated[
    str, typer.Option(help="The folder, or bucket such as s3://bucket/path, that keeps the result of every stage.")
]
ChunksOption = Annotated[
    str | None,
    typer.Option(help="Numbers of the chunks to use, separated by commas, such as 0,1. All chunks if not given."),
]
ChunkOption = Annotated[int, typer.Option(help="The number of the chunk in the log, from 0.")]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="Print what would be computed and how long it would take, then stop.")
]
JsonOption = Annotated[
    bool,
    typer.Option("--json", help="Print one JSON object instead of tables, whether or not the command succeeds."),
]

RunArgument = Annotated[
    str,
    typer.Argument(help="The name of a finished run, or its first characters. `genre show runs` lists the names."),
]
RunChunkOption = Annotated[
    int | None, typer.Option(help="The number of a chunk of the run. The run's first chunk if not given.")
]
SceneStageOption = Annotated[
    str | None,
    typer.Option(help="The stage whose scene is used: initial, gnet or enet. The run's last one if not given."),
]

MethodsOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--method",
        parser=parse_path,
        metavar="PATH",
        help="A YAML file that describes one more method, with the keys name, settings, end and note. May be given "
        "several times.",
    ),
]
WeightsOption = Annotated[
    list[str] | None,
    typer.Option(
        help="Weights that do not ship, as NAME=PATH. The names are difix and streetcrafter (fixers) and enet-g3r. May "
        "be given several times."
    ),
]
