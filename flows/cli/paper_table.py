"""``genre table``: a table of the paper, measured here, with the paper's numbers beside."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.detector_table import (
    NUMBER,
    DetectorTableParts,
    refuse_other_options,
    refuse_table_8_options,
)
from flows.cli.options import (
    ChunksOption,
    DryRunOption,
    MethodsOption,
    OptionalLogsArgument,
    PresetOption,
    SettingsOption,
    StoreOption,
    WeightsOption,
)
from flows.cli.parsing import parse_numbers, parse_path
from flows.cli.scene_options import (
    ChunkFramesOption,
    ImagesOption,
    LidarOption,
    ScaleOption,
    SceneCamerasOption,
    SceneOption,
    UpOption,
    list_scene_options,
    make_scene_inputs,
)
from flows.defaults import DEFAULT_STORE

if TYPE_CHECKING:
    from flows.paper_tables.request import CheckedRequest, TableRequest

TableNumberArgument = Annotated[
    int,
    typer.Argument(
        help="The table's number: 1 comparison of methods, 2 GenRe after other methods, 3 fixers by their inputs, 4 "
        "ablation, 5 runtime by phase, 6 re-simulation with other behaviours, 7 agreement of a detector "
        "across cameras, 8 a detector trained with renders."
    ),
]
TableFolderOption = Annotated[
    Path,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="The folder for the table as Markdown and as Parquet, tableN_DATASET.md and .parquet, over earlier ones.",
    ),
]
PageOption = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="A Markdown page that collects several tables; the section of this table is replaced.",
    ),
]
RemarksOption = Annotated[
    list[str] | None,
    typer.Option("--remark", help="A sentence for the reader, written below the table. May be given several times."),
]
TableDetectorOption = Annotated[
    str | None,
    typer.Option(
        "--detector",
        help="For table 7, the detector: an ONNX or TFLite file, torchvision:NAME or detectron2:CONFIG. One with masks "
        "fills the columns of masks too.",
    ),
]
TestLogsOption = Annotated[
    list[str] | None,
    typer.Option("--test", help="For table 8, a log to test detectors on, as LOG. May be given several times."),
]
SeedsOption = Annotated[
    int | None,
    typer.Option(help="For table 8, the number of trainings of each row. If not given, 3."),
]
StepsOption = Annotated[
    int | None,
    typer.Option(help="For table 8, the gradient steps of a training. If not given, 3000."),
]
StoredOption = Annotated[
    bool,
    typer.Option("--stored", help="Compute nothing, and leave out methods whose stages are not all in the store."),
]


def table(
    number: TableNumberArgument,
    logs: OptionalLogsArgument = None,
    preset: PresetOption = "small",
    chunks: ChunksOption = None,
    settings: SettingsOption = None,
    methods: MethodsOption = None,
    weights: WeightsOption = None,
    store: StoreOption = DEFAULT_STORE,
    out: TableFolderOption = Path("tables"),
    into: PageOption = None,
    remarks: RemarksOption = None,
    stored: StoredOption = False,
    scene: SceneOption = None,
    cameras: SceneCamerasOption = None,
    images: ImagesOption = None,
    lidar: LidarOption = None,
    up: UpOption = "auto",
    scale: ScaleOption = None,
    chunk_frames: ChunkFramesOption = None,
    detector: TableDetectorOption = None,
    test: TestLogsOption = None,
    seeds: SeedsOption = None,
    steps: StepsOption = None,
    dry_run: DryRunOption = False,
) -> None:
    """Measure a table of the paper, with the paper's numbers beside.

    Every method runs on every chunk by the paper's protocol. All logs must be of one dataset.
    Finished stages come from the store, so a table that was stopped goes on where it was, and tables share stages.
    Table 2 also takes a 3D Gaussian scene of any program in the place of logs, and compares it before and after.

    Example:

    \b
        genre table 4 'synthetic:street?seed=1000'
        genre table 2 --scene point_cloud.ply --cameras transforms.json --scale 1
        genre table 7 pandaset:PATH/002 --chunks 1 --detector yolox_nano.onnx
        genre table 8 'synthetic:street?seed=100' --test 'synthetic:street?seed=900'
    """
    from flows.paper_tables.request import TableRequest

    _check_outputs(out, into)
    numbers = parse_numbers(chunks, "--chunks")
    if number == NUMBER:
        options = list_scene_options(cameras, images, lidar, up=up, scale=scale, chunk_frames=chunk_frames)
        refuse_other_options(methods, weights, into, remarks, stored, scene, detector, scene_options=options)
        return DetectorTableParts(logs, test, preset, store, numbers, settings, out).measure(seeds, steps, dry_run)
    refuse_table_8_options(test, seeds, steps)
    request = TableRequest(
        number=number,
        logs=tuple(logs or ()),
        preset=preset,
        store=store,
        chunks=None if numbers is None else tuple(numbers),
        settings=tuple(settings or ()),
        methods=tuple(str(file) for file in methods or ()),
        weights=tuple(weights or ()),
        out=str(out),
        into=None if into is None else str(into),
        remarks=tuple(remarks or ()),
        stored=stored,
        scene=make_scene_inputs(scene, cameras, images, lidar, up=up, scale=scale, chunk_frames=chunk_frames),
        detector=detector,
    )
    _measure_or_predict(request, dry_run)


def _check_outputs(out: Path, into: Path | None) -> None:
    from flows.cli.output_paths import check_output_file, check_output_folder

    check_output_folder(out, "--out")
    if into is not None:
        check_output_file(into, "--into")


def _measure_or_predict(request: TableRequest, dry_run: bool) -> None:
    """Checks a request, prints what was found or assumed about a scene, and measures or predicts."""
    # Mistakes in the request show here, before Prefect's server takes seconds to start.
    checked = request.check()
    for line in checked.explanation:
        typer.echo(line, err=True)
    if dry_run:
        _print_prediction(checked)
    else:
        _measure_table(request)


def _print_prediction(checked: CheckedRequest) -> None:
    from flows.cli.printing import print_rows
    from flows.paper_tables.request import predict_table

    rows = predict_table(checked)
    print_rows(f"{len(rows)} cells, {sum(row['seconds'] for row in rows) / 60:.0f} minutes", rows)


def _measure_table(request: TableRequest) -> None:
    from flows.cli.terminal import report_on_terminal
    from flows.paper_tables.flow import paper_table

    # Plain values and not the request: Prefect keeps a flow's parameters, and a worker may be given them.
    with report_on_terminal():
        done: dict[str, Any] = paper_table(
            request.number,
            list(request.logs),
            preset=request.preset,
            store=request.store,
            chunks=None if request.chunks is None else list(request.chunks),
            settings=list(request.settings),
            methods=list(request.methods),
            weights=list(request.weights),
            out=request.out,
            into=request.into,
            remarks=list(request.remarks),
            stored=request.stored,
            scene=None if request.scene is None else request.scene.to_values(),
            detector=request.detector,
        )
    typer.echo(f"{done['cells']} cells, {len(done['failed'])} left out; wrote {', '.join(done['files'])}")
    if done["failed"]:
        raise typer.Exit(1)
