"""``genre table 8``: detectors trained on recorded images alone, and with renders of scenes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from genre_tasks.errors import ConfigError

if TYPE_CHECKING:
    from flows.paper_tables.detector_flow import DetectorRequest
    from flows.paper_tables.detector_study import DetectorStudy

NUMBER = 8
OTHER_OPTIONS = ("--method", "--weights", "--into", "--remark", "--stored", "--scene", "--detector")
_SECONDS_PER_STEP = 0.2
"""Measured on one core: eight images of 320×180."""


@dataclass(frozen=True)
class DetectorTableParts:
    """Options that table 8 shares with the other tables, as the command line has them.

    Attributes:
        logs: to train on.
        test: logs to test on.
        preset: name of the preset.
        store: folder of the store.
        chunks: of each log; all if ``None``.
        settings: ``section.key=value``.
        out: folder to write into.
    """

    logs: list[str] | None
    test: list[str] | None
    preset: str
    store: str
    chunks: list[int] | None
    settings: list[str] | None
    out: Path

    def request(self, seeds: int | None, steps: int | None) -> DetectorRequest:
        """Makes the request.

        Args:
            seeds: trainings of each row; ``None``: the request's default.
            steps: of a training.
        """
        from flows.paper_tables.detector_flow import DetectorRequest

        return DetectorRequest(
            train=tuple(self.logs or ()),
            test=tuple(self.test or ()),
            preset=self.preset,
            store=self.store,
            chunks=None if self.chunks is None else tuple(self.chunks),
            settings=tuple(self.settings or ()),
            seeds=DetectorRequest.seeds if seeds is None else seeds,
            steps=steps,
            out=str(self.out),
        )

    def measure(self, seeds: int | None, steps: int | None, dry_run: bool) -> None:
        """Measures the table, or prints what it would take.

        Args:
            seeds: trainings of each row; ``None``: the request's default.
            steps: of a training.
            dry_run: whether nothing is computed.

        Raises:
            GenreError: the request is wrong, or a stage or training fails.
        """
        _measure_detector_table(self.request(seeds, steps), dry_run)


def _measure_detector_table(request: DetectorRequest, dry_run: bool) -> None:
    from flows.cli.terminal import report_on_terminal
    from flows.paper_tables.detector_flow import detector_table

    # Mistakes in the request show here, before Prefect's server takes seconds to start.
    study = request.check()
    if dry_run:
        _print_prediction(study, request.seeds)
        return
    with report_on_terminal():
        done: dict[str, Any] = detector_table(
            list(request.train),
            list(request.test),
            preset=request.preset,
            store=request.store,
            chunks=None if request.chunks is None else list(request.chunks),
            settings=list(request.settings),
            seeds=request.seeds,
            steps=request.steps,
            out=request.out,
        )
    typer.echo(f"{done['trainings']} trainings; wrote {', '.join(done['files'])}")


def refuse_table_8_options(test: list[str] | None, seeds: int | None, steps: int | None) -> None:
    """Checks that options of table 8 are not given for another table.

    Args:
        test: logs to test on.
        seeds: trainings of each row.
        steps: of a training.

    Raises:
        ConfigError: one is given.
    """
    # An option without effect would hide a mistake in the number of the table.
    for option, value in (("--test", test), ("--seeds", seeds), ("--steps", steps)):
        if value is not None:
            raise ConfigError(f"{option} belongs to table {NUMBER}", remedy=f"Leave it out, or ask for table {NUMBER}.")


def refuse_other_options(*values: object, scene_options: Mapping[str, object]) -> None:
    """Checks that options of other tables are not given for table 8.

    Args:
        values: those of ``OTHER_OPTIONS``; ``None``, ``False`` and an empty list stand for one that is not given.
        scene_options: the values of those that belong to a scene.

    Raises:
        ConfigError: one is given.
    """
    by_option = {**dict(zip(OTHER_OPTIONS, values, strict=True)), **scene_options}
    for option, value in by_option.items():
        # Without an effect it would be taken for one that has one. A zero is a value, too.
        if value is not None and value is not False and value != []:
            raise ConfigError(f"table {NUMBER} has no use for {option}", remedy="Leave it out.")


def _print_prediction(study: DetectorStudy, seeds: int) -> None:
    from flows.cli.printing import print_rows
    from flows.experiments.stage_prediction import StagePredictor
    from flows.paper_tables.detector_study import ROWS, list_methods
    from flows.pipeline.definition import stages_until
    from genre_tasks.config import PipelineConfig

    predictor = StagePredictor(study.store)
    rows: list[dict[str, Any]] = []
    for where in study.train:
        for method in list_methods():
            source = study.build_source(where, method)
            base = PipelineConfig.model_validate(source.job.config)
            names = stages_until(str(source.end))
            rows.append(predictor.predict(f"{method} · {where}", source.job, base, names))
    # Trainings are predicted in full, since only their images tell whether they are there.
    seconds = _SECONDS_PER_STEP * study.detector.steps
    trainings = [(label, seed) for label in ROWS.values() for seed in range(seeds)]
    rows += [{"cell": f"{label} · seed {seed}", "seconds": seconds, "cached": ""} for label, seed in trainings]
    print_rows(f"{len(rows)} cells, {sum(row['seconds'] for row in rows) / 60:.0f} minutes", rows)
