"""``genre perceive``: what a detector finds in a finished run's scene, on the path and next to it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.options import RunArgument, RunChunkOption, SceneStageOption, StoreOption
from flows.cli.parsing import parse_path
from flows.cli.shifts import parse_shifts
from flows.defaults import DEFAULT_STORE

_MAX_COUNT = 1_000_000


DetectorOption = Annotated[
    str,
    typer.Option(
        metavar="DETECTOR",
        help="An ONNX or TFLite file of FastestDet or of a YOLO family, torchvision:NAME, or detectron2:CONFIG.",
    ),
]
PerceptionFolderOption = Annotated[
    Path,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="The folder for detections.parquet and perception.png; those that are there are replaced.",
    ),
]
ShiftsOption = Annotated[
    str,
    typer.Option(
        help="How many metres to the left of the path scenes are rendered; negative is to the right, and ±3 is "
        "both sides. Several are separated by commas. Renders at 0 are compared with the recorded images."
    ),
]
ClassNamesOption = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="A text file with the names of the detector's classes, one a line. Those in the detector's file, or "
        "COCO's, if not given.",
    ),
]


def perceive(
    run: RunArgument,
    detector: DetectorOption,
    out: PerceptionFolderOption,
    shift: ShiftsOption = "0,1,2,3",
    cameras: Annotated[
        str | None, typer.Option(help="Names of cameras, separated by commas. All cameras if not given.")
    ] = None,
    every: Annotated[int, typer.Option(help="Take every n-th frame.")] = 1,
    class_names: ClassNamesOption = None,
    min_score: Annotated[float, typer.Option(help="Leave out detections with a lower score.")] = 0.3,
    stage: SceneStageOption = None,
    chunk: RunChunkOption = None,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Run a detector on a finished run's recorded and rendered images.

    The table has a row for every detection, with its mask where the detector gives masks. The picture shows the
    middle frame. Renders on the path are compared with the recorded images: what the detector finds there is taken for
    the truth. Next to the path no image was recorded, and finds are counted alone; so they are with edited traffic.

    Example:

    \b
        genre perceive 4b1c --detector yolox_nano.onnx --shift 0,3 --out perception
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.output_paths import check_output_folder
    from flows.cli.parsing import check_number
    from flows.cli.printing import print_rows
    from flows.cli.terminal import TerminalReporter

    check_output_folder(out, "--out", ("detections.parquet", "perception.png"))
    shifts_m = parse_shifts(shift, "--shift")
    check_number(every, "--every", 1, _MAX_COUNT)
    check_number(min_score, "--min-score", 0, 1)
    names = None if cameras is None else tuple(name.strip() for name in cameras.split(","))
    open_existing_store(store)
    with TerminalReporter("perceiving") as reporter:
        # Loading torch takes seconds, in which a mistyped option would wait.
        from flows.perception.perceive import PerceiveRequest, perceive_run, tabulate_perception
        from genre_tasks.detection.detector import open_detector

        network = open_detector(detector, class_names, min_score)
        request = PerceiveRequest(store, run, out, chunk, stage, tuple(shifts_m), names, every)
        perception = perceive_run(request, network, reporter.progress)
    title = f"{perception.log}, chunk {perception.chunk}, after {perception.stage}"
    print_rows(title, tabulate_perception(perception))
    if perception.no_agreement:
        typer.echo(f"no agreement: {perception.no_agreement}")
    # The list of all of a detector's classes would fill the screen.
    shown = perception.counted[:10]
    more = f" and {len(perception.counted) - len(shown)} more" if len(perception.counted) > len(shown) else ""
    typer.echo(f"counted: {', '.join(shown)}{more}; wrote {', '.join(perception.files)}")
