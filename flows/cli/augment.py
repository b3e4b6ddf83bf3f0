"""``genre augment``: training sets for detectors, with images of paths that no vehicle has driven."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.options import SceneStageOption, StoreOption
from flows.cli.parsing import parse_path
from flows.cli.shifts import parse_shifts
from flows.defaults import DEFAULT_STORE

_MAX_COUNT = 1_000_000

RunsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="RUN...",
        help="The names of finished runs, or their first characters. `genre show runs` lists the names.",
    ),
]
SetFolderOption = Annotated[
    Path,
    typer.Option(parser=parse_path, metavar="PATH", help="The folder of the training set; a new one, or an empty one."),
]
ShiftsOption = Annotated[
    str,
    typer.Option(
        help="How many metres to the left of the path scenes are rendered; negative is to the right, and ±3 is "
        "both sides. Several are separated by commas: 1,2 or -3,3."
    ),
]
FormatOption = Annotated[
    str,
    typer.Option(
        "--format", help="The layout: kitti, nuscenes, coco (rectangles alone) or own (Parquet tables and PNG images)."
    ),
]
MinPointsOption = Annotated[
    int,
    typer.Option(
        help="How many LiDAR points a box needs to be in the set. Boxes of which nearer surfaces hide more than "
        "95 % are left out in any case."
    ),
]


def augment(
    runs: RunsArgument,
    out: SetFolderOption,
    shift: ShiftsOption = "±3",
    format_name: FormatOption = "kitti",
    stage: SceneStageOption = None,
    every: Annotated[int, typer.Option(help="Take every n-th frame of each chunk.")] = 1,
    no_recorded: Annotated[bool, typer.Option("--no-recorded", help="Leave the recorded images out.")] = False,
    min_points: MinPointsOption = 1,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Make a training set with images next to the recorded path.

    The scenes of finished runs are rendered at the recorded poses, moved to the side, and the boxes of the log's
    annotation move with them. The recorded images are in the set, too.

    Example:

    \b
        genre augment 4b1c --shift ±3m --format kitti --out training
        genre augment 4b1c 77d0 --shift 1,2 --every 2 --format coco --out training
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.output_paths import check_new_folder
    from flows.cli.parsing import check_number
    from flows.cli.terminal import TerminalReporter

    check_new_folder(out, "--out")
    shifts_m = parse_shifts(shift, "--shift")
    check_number(every, "--every", 1, _MAX_COUNT)
    check_number(min_points, "--min-points", 0, _MAX_COUNT)
    open_existing_store(store)
    with TerminalReporter("augmenting") as reporter:
        # Loading torch takes seconds, in which a mistyped option would wait.
        from flows.perception.augment import AugmentRequest, augment_runs

        request = AugmentRequest(
            store, runs, shifts_m, format_name, out, stage, every, recorded=not no_recorded, min_points=min_points
        )
        written = augment_runs(request, reporter.progress, reporter.part_started)
    typer.echo(f"wrote {out}: {written.images} images with {written.boxes} boxes, as {format_name}")
