"""Options that edit a run's traffic, which several commands share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.parsing import parse_path

if TYPE_CHECKING:
    from genre_tasks.scene_edits.edits import EditList

EditsOption = Annotated[
    Path | None,
    typer.Option(
        "--edits",
        parser=parse_path,
        metavar="PATH",
        help="A YAML file with a list `edits` of remove, insert, move, retime, rotate and scale_speed.",
    ),
]
RemoveOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ACTOR", help="Remove an actor: its name, number or track id. All these may be given several times."
    ),
]
InsertOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ACTOR",
        help="Insert an actor on the recorded path: NAME@RUN:ACTOR,ahead=M,left=M,turn=DEG,speed=M/S,start=S, such as "
        "taxi@4b1c:7,ahead=12. All but ACTOR may be left out.",
    ),
]
MoveOption = Annotated[
    list[str] | None,
    typer.Option(metavar="ACTOR", help="Move an actor along its axes: ACTOR,forward=M,left=M,up=M; any of the three."),
]
RetimeOption = Annotated[
    list[str] | None,
    typer.Option(metavar="ACTOR", help="Let an actor drive its path later: ACTOR,delay=S; negative is earlier."),
]
RotateOption = Annotated[
    list[str] | None,
    typer.Option(metavar="ACTOR", help="Turn an actor about its vertical axis to the left: ACTOR,degrees=DEG."),
]
ScaleSpeedOption = Annotated[
    list[str] | None,
    typer.Option(metavar="ACTOR", help="Let an actor drive its path faster or slower: ACTOR,factor=N."),
]


def read_edits(
    file: Path | None,
    *,
    remove: Sequence[str] | None = None,
    insert: Sequence[str] | None = None,
    move: Sequence[str] | None = None,
    retime: Sequence[str] | None = None,
    rotate: Sequence[str] | None = None,
    scale_speed: Sequence[str] | None = None,
) -> EditList:
    """Puts the edits of a file and those of the options together, the file's first.

    Args:
        file: a YAML file; ``None``: none.
        remove: as the options are written, like the others.
        insert: as :func:`flows.simulation.edit_file.parse_edit_options` reads them.
        move: likewise.
        retime: likewise.
        rotate: likewise.
        scale_speed: likewise.

    Returns:
        The edits; none without a file and options.

    Raises:
        ConfigError: the file or an option cannot be read.
    """
    from flows.simulation.edit_file import parse_edit_options, read_edit_file
    from genre_tasks.scene_edits.edits import EditList

    from_file = EditList() if file is None else read_edit_file(file)
    from_options = parse_edit_options(
        remove=remove or (),
        insert=insert or (),
        move=move or (),
        retime=retime or (),
        rotate=rotate or (),
        scale_speed=scale_speed or (),
    )
    return from_file + from_options
