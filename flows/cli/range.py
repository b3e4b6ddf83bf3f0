"""``genre range``: how far beside the path a finished run's scene can be trusted."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.options import RunArgument, RunChunkOption, SceneStageOption, StoreOption
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_STORE

if TYPE_CHECKING:
    from genre_tasks.config import RangeConfig
    from genre_tasks.detection.detector import Detector
    from genre_tasks.reliability.reliable_range import CurvePoint, ReliableRange

DetectorOption = Annotated[
    str | None,
    typer.Option(
        metavar="DETECTOR",
        help="A detector that knows road users: an ONNX or TFLite file of FastestDet or of a YOLO family, "
        "torchvision:NAME or detectron2:CONFIG. The fraction of actors that it finds is then one more guard.",
    ),
]
RangeFolderOption = Annotated[
    Path,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="The folder for range.parquet and range.png; those that are there are replaced.",
    ),
]


def range_command(
    run: RunArgument,
    stage: SceneStageOption = None,
    chunk: RunChunkOption = None,
    max_drop_db: Annotated[
        float, typer.Option(help="By how many dB the median view's estimated PSNR may be below that on the path.")
    ] = 3.0,
    every: Annotated[int, typer.Option(help="Render every n-th frame.")] = 4,
    store: StoreOption = DEFAULT_STORE,
    detector: DetectorOption = None,
    out: RangeFolderOption = Path("range"),
) -> None:
    """Estimate how far beside the path a scene can be trusted.

    Views beside the path have no true image to compare with, so guards stand in its place: agreement with the recorded
    images, surfaces that no image shows, holes, floating Gaussians, and actors that a detector no longer finds.

    The run's report gets the range and its curve, too.

    Where the run has the next chunk too, the same views are rendered from both scenes and compared.

    Example:

    \b
        genre range 4b1c --max-drop-db 2 --out range
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.output_paths import check_output_folder
    from flows.cli.parsing import check_number
    from flows.cli.printing import print_rows
    from flows.cli.terminal import TerminalReporter
    from flows.reconstruction.reliable_range import write_range
    from flows.reconstruction.stored_values import find_last_stage, read_next_scene, read_stage_scene, read_stage_value
    from genre_tasks.effects.apply_plan import apply_plan
    from genre_tasks.reliability.chunk_seam import measure_seam, median_psnr_by_distance
    from genre_tasks.reliability.reliable_range import estimate_reliable_range

    check_output_folder(out, "--out", ("range.parquet", "range.png"))
    config = _range_config(max_drop_db, every)
    check_number(max_drop_db, "--max-drop-db", 0, 100)
    open_existing_store(store)
    network = _load_detector(detector)
    number, ingested = read_stage_value(store, run, chunk, "ingest")
    scene_stage = find_last_stage(store, run, number) if stage is None else stage
    _, plan = read_stage_value(store, run, number, "effects")
    scene = read_stage_scene(store, run, number, scene_stage)
    with TerminalReporter(f"chunk {number}  guards") as reporter:
        reliable_range = estimate_reliable_range(config, ingested, scene, plan, reporter.progress, network)
    # With --stage the next chunk is compared after the same stage, without it each after its own last one.
    following = read_next_scene(store, run, number, stage)
    facts = {"log": ingested.log, "chunk": str(number), "stage": scene_stage, "run": run}
    files = write_range(out, reliable_range, facts)
    rows = [_point_row(point) for point in reliable_range.points]
    print_rows(f"{ingested.log}, chunk {number}, after {scene_stage}", rows)
    files += _update_run(store, run, number, scene_stage, reliable_range)
    typer.echo(f"{reliable_range}; wrote {', '.join(files)}")
    if following is not None:
        psnr_by_distance = median_psnr_by_distance(measure_seam((apply_plan(ingested, plan), scene), following))
        values = ", ".join(f"{db:.1f} dB at {distance:g} m" for distance, db in psnr_by_distance.items())
        typer.echo(f"seam to chunk {number + 1}, the same view from both scenes without actors: {values}")


def _load_detector(path_or_name: str | None) -> Detector | None:
    # Without a detector the other guards decide alone.
    if path_or_name is None:
        return None
    from genre_tasks.reliability.detected_actors import open_actor_detector

    return open_actor_detector(path_or_name)


def _update_run(store: str, run: str, chunk: int, stage: str, reliable_range: ReliableRange) -> list[str]:
    """Writes the range into the run's folder and report; the report's path in a list, which is empty after an error."""
    from flows.reconstruction.range_record import write_range_record
    from flows.reconstruction.rewritten_report import rewrite_report
    from flows.reconstruction.run_records import find_run_folder, name_run_folder
    from genre_tasks.errors import GenreError
    from storage.opening import open_store

    try:
        folder = find_run_folder(store, run)
        write_range_record(folder, chunk, stage, reliable_range)
        open_store(store).records.push(name_run_folder(folder.name))
        return [str(rewrite_report(store, run))]
    except (OSError, GenreError) as error:
        # The range itself is there, and took minutes: the store may be one that can only be read.
        typer.echo(f"note: the run's report stays as it was: {error}", err=True)
        return []


def _range_config(max_drop_db: float, every: int) -> RangeConfig:
    from pydantic import ValidationError

    from genre_tasks.config import RangeConfig
    from genre_tasks.errors import ConfigError

    try:
        return RangeConfig(max_drop_db=max_drop_db, every=every)
    except ValidationError as error:
        wrong = error.errors()[0]
        option = "--" + str(wrong["loc"][0]).replace("_", "-")
        raise ConfigError(f"{option}: {wrong['msg']}", remedy="See `genre range --help`.") from error


def _point_row(point: CurvePoint) -> dict[str, Any]:
    # One row for each shift, from right to left, as the curve in range.png.
    return {
        "shift": f"{point.shift_m:+g} m",
        "views": point.views,
        "estimate": f"{point.estimate_db:.1f} dB",
        "agreement": f"{point.agreement_db:.1f} dB",
        "shown": f"{point.shown:.1%}",
        "thin": f"{point.thin:.1%}",
        "floating": f"{point.floating:.1%}",
        "detected": "" if math.isnan(point.detected) else f"{point.detected:.0%}",
        "": "holds" if point.holds else "",
    }
