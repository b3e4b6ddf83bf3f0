"""Perception: how far detectors agree on recorded and rendered images, and whether renders train one.

genre bench perception --json docs/results/data/perception.json [--set seeds=1001,1002] [--set pandaset=]
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

from benchmarks.common.bench import (
    TINY_SETTINGS,
    TINY_STREET,
    Bench,
    Cell,
    Row,
    SmallestForm,
    list_not_measured,
    settings_from_options,
    split_option,
)
from benchmarks.common.claims import Claim
from benchmarks.common.lazy_modules import STAGE_MODULES
from benchmarks.perception.camera_transfer import camera_transfer_claims, camera_transfer_table, measure_camera_transfer
from benchmarks.perception.metric_checks import measure_metrics, metric_claims
from benchmarks.perception.scenes import METHOD, OTHER_METHODS, PerceptionCase
from benchmarks.perception.shifts import COMPARED, measure_range, measure_shifts, shift_claims, shift_table
from benchmarks.perception.speed import measure_speed, speed_claims
from benchmarks.perception.training import TrainingCase, measure_training, training_claims, training_table
from flows.paper_tables.detector_study import ROWS

# Estimates for two quiet cores with all scenes in the store.
_TRANSFER_S = 120.0
_SHIFTS_S = 60.0
_RANGE_S = 70.0
_SPEED_S = 60.0
_TRAINING_S = 600.0
_METRICS_S = 10.0
_RANGE_LOGS = 3
_TRAINING_SEEDS = 3


class PerceptionBench:
    """Table 7 on the real log, agreement over shift on streets, table 8 on streets, and the seconds of detectors."""

    name = "perception"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003,1004,1005,1006,1007,1008,1009,1010",
        "train": "100,101,102,103,104,105,106,107",
        "trainings": "4x3000x0.7",
        "pandaset": "../shared/data/pandaset/002",
        "chunks": "0,1",
        "detectors": "../shared/data/detectors",
        "boxes": "yolox_nano.onnx,FastestDet.onnx",
        "masks": "yolov8n-seg_int8.tflite",
        "settings": "gnet.per_scene.iterations=1000",
        "transfer_settings": "ingest.width_px=640 ingest.height_px=360 initial.max_points=80000",
        "store": "genre-store",
    }
    code: tuple[str, ...] = (
        "benchmarks.perception.camera_transfer",
        "benchmarks.perception.shifts",
        "benchmarks.perception.training",
        "benchmarks.perception.speed",
        "benchmarks.perception.metric_checks",
        # They render, detect, train and test.
        "flows.paper_tables.agreement_cells",
        "flows.paper_tables.detector_study",
        "flows.perception.camera_transfer",
        *STAGE_MODULES,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )
    smallest = SmallestForm(
        {
            "seeds": TINY_STREET,
            "train": TINY_STREET.replace("900", "901"),
            "trainings": "1x2",
            "pandaset": "",
            "settings": TINY_SETTINGS,
        },
        "training 1x2 real seed 0",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the cells; ``quick`` takes one street, the last chunk and one training of each row."""
        settings = settings_from_options(options)
        store = options["store"]
        seeds = split_option(options["seeds"])[: 1 if quick else None]
        streets = [PerceptionCase(f"synthetic:street?seed={seed}", 0, store, settings) for seed in seeds]
        boxes = tuple(split_option(options["boxes"]))
        every = (*boxes, *split_option(options["masks"]))
        folder = options["detectors"]
        asked = {"detectors": list(every)}
        cells = [
            Cell("metrics", _METRICS_S, measure_metrics),
            Cell("speed", _SPEED_S, partial(measure_speed, folder, every), asked),
        ]
        # Cars a lane away are a few pixels wide at the preset's size.
        larger = (*settings, *options["transfer_settings"].split())
        chunks = [int(number) for number in split_option(options["chunks"])]
        # Of the last one, as claims are made of none that networks were trained on.
        for chunk in chunks[-1:] if quick else chunks:
            # Real data is not shipped, so the benchmark has to run without it.
            if options["pandaset"]:
                case = PerceptionCase(f"pandaset:{options['pandaset']}", chunk, store, larger)
                measure = partial(measure_camera_transfer, case, folder, every)
                parameters = case.describe((METHOD, *OTHER_METHODS)) | asked
                cells.append(Cell(f"transfer {case.name}", _TRANSFER_S, measure, parameters))
        for case in streets:
            parameters = case.describe(COMPARED) | asked
            measure = partial(measure_shifts, case, folder, every)
            cells.append(Cell(f"shifts {case.name}", _SHIFTS_S, measure, parameters))
        for case in streets[:_RANGE_LOGS]:
            cells.append(Cell(f"range {case.name}", _RANGE_S, partial(measure_range, case), case.describe((METHOD,))))
        return cells + self._training_cells(options, quick, streets)

    def _training_cells(self, options: Mapping[str, str], quick: bool, streets: list[PerceptionCase]) -> list[Cell]:
        logs = tuple(f"synthetic:street?seed={seed}" for seed in split_option(options["train"]))
        cells = []
        for size in split_option(options["trainings"])[: 1 if quick else None]:
            # Streets, steps, and how much of a box may be hidden.
            count, steps, hidden = (*size.split("x"), "1")[:3]
            case = TrainingCase(
                logs[: int(count)],
                tuple(street.log for street in streets),
                settings_from_options(options),
                options["store"],
                int(steps),
                float(hidden),
                Path(options["store"]).parent / "detectors",
            )
            for row in ROWS:
                for seed in range(1 if quick else _TRAINING_SEEDS):
                    measure = partial(measure_training, case, row, seed)
                    cells.append(Cell(f"training {size} {row} seed {seed}", _TRAINING_S, measure, case.describe(row)))
        return cells

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes the claims, section by section."""
        yield from camera_transfer_claims(_select(rows, "transfer"))
        yield from shift_claims(_select(rows, "shifts"))
        yield from training_claims(_select(rows, "training"))
        yield from metric_claims(_select(rows, "metrics"))
        yield from speed_claims(_select(rows, "speed"))

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Gives a table for each section, and what was not measured."""
        yield from training_table(_select(rows, "training"))
        yield ""
        yield from camera_transfer_table(_select(rows, "transfer"))
        yield ""
        yield from shift_table(_select(rows, "shifts"))
        yield from list_not_measured(rows)


def _select(rows: Mapping[str, Row], kind: str) -> list[Row]:
    """The rows of one kind of cell that were measured."""
    return [row for name, row in rows.items() if name.split()[0] == kind and "not_measured" not in row]


BENCH: Bench = PerceptionBench()
