"""What a user asks for, checked before anything is computed; and what it would take."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flows.configuration import load_configuration
from flows.enhancement.enhancement_request import EnhancementInputs, prepare_enhancement
from flows.experiments.log_chunks import LogChunk, select_log_chunks
from flows.experiments.stage_prediction import StagePredictor, find_stored_stages
from flows.paper_tables.agreement_cells import open_cached_detector, restrict_to_front_camera
from flows.paper_tables.layouts import LAYOUTS, Layout, Row, get_layout
from flows.paper_tables.measure import PRESET_METHOD, Basis, list_stages
from flows.paper_tables.rollout_cells import count_missing_rollouts, predict_rollouts
from flows.paper_tables.user_methods import read_method
from flows.paper_tables.weights_slots import SLOTS, read_weights
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import Job
from flows.preflight.requirements import check_jobs
from genre_tasks.config import PipelineConfig
from genre_tasks.detection.coco_classes import require_road_users
from genre_tasks.errors import ConfigError


@dataclass(frozen=True)
class _Inputs:
    # What is measured: logs, the settings over the protocol, and what was found or assumed about a scene.
    logs: tuple[str, ...]
    settings: tuple[str, ...]
    explanation: tuple[str, ...] = ()


@dataclass(frozen=True)
class TableRequest:
    """What a user asks for; its files are read by :meth:`check`.

    Attributes:
        number: of the table, 1 to 7.
        logs: URIs; ``pandaset:PATH/*`` stands for every sequence in a folder; none where there is a scene.
        preset: name of the preset.
        store: folder of the store.
        chunks: of each log; all if ``None``.
        settings: ``section.key=value`` over the preset and the paper's protocol.
        methods: YAML files of further methods.
        weights: ``NAME=PATH`` of weights that do not ship.
        out: folder to write into.
        into: a Markdown page whose section of this table is replaced.
        remarks: what else the reader should know.
        stored: whether methods that the store has not completely are left out.
        scene: a scene of another program, with its cameras and images, in the place of logs.
        detector: file or name of the detector that table 7 asks.
    """

    number: int
    logs: tuple[str, ...]
    preset: str = "small"
    store: str = "genre-store"
    chunks: tuple[int, ...] | None = None
    settings: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    weights: tuple[str, ...] = ()
    out: str = "tables"
    into: str | None = None
    remarks: tuple[str, ...] = ()
    stored: bool = False
    scene: EnhancementInputs | None = None
    detector: str | None = None

    def check(self) -> CheckedRequest:
        """Reads the files, finds the table's rows and chunks, and checks that all stages can run.

        Raises:
            ConfigError: a table, method, setting or name of weights does not exist, or the logs are of several
                datasets.
            InputError: a log, chunk or file of weights does not exist, or the store cannot be written to.
        """
        of_scene = self.scene is not None
        inputs = self._find_inputs(get_layout(self.number, of_scene=of_scene).protocol)
        self._check_detector()
        basis = Basis(self.preset, inputs.settings, self.store)
        # Files are read once, as they could change while the table is measured.
        user_methods = [read_method(Path(f), self.preset, inputs.settings) for f in self.methods]
        layout = get_layout(self.number, user_methods, of_scene=of_scene)
        weights = read_weights(self.weights)
        config = load_configuration(self.preset, settings=(*layout.protocol, *inputs.settings))
        chunks = None if self.chunks is None else list(self.chunks)
        places = select_log_chunks(inputs.logs, chunks, config)
        datasets = sorted({cached_log(where.log).dataset for where in places})
        # Image sizes and difficulty differ so much that a mean would depend on the mix alone.
        if len(datasets) > 1:
            raise ConfigError(
                f"the logs are of several datasets ({', '.join(datasets)}), over which no mean says anything",
                remedy="Measure them one after the other; --into keeps a section for each.",
            )
        missing = {
            row.label: f"no weights; give {SLOTS[row.method.slot].about} by --weights {row.method.slot}=PATH."
            for row in layout.rows
            if row.method.needs_weights and row.method.slot not in weights
        }
        # Weights change the notes too, so the layout itself is rebuilt.
        rows = tuple(replace(row, method=row.method.with_weights(weights)) for row in layout.rows)
        checked = CheckedRequest(
            basis,
            replace(layout, rows=rows),
            tuple(places),
            missing,
            "".join(datasets),
            inputs.explanation,
            self.detector,
        )
        if layout.across_cameras:
            checked = replace(checked, layout=restrict_to_front_camera(checked.layout, places[0].log))
        # What is only read from the store needs neither weights nor a store that can be written to.
        if not self.stored:
            check_jobs(checked.list_jobs())
        return checked

    def _check_detector(self) -> None:
        """Opens the detector, so that a wrong file is found before hours of computing."""
        if not LAYOUTS[self.number].across_cameras:
            if self.detector is not None:
                raise ConfigError(f"table {self.number} asks no detector", remedy="Leave out --detector.")
            return
        if self.detector is None:
            raise ConfigError(
                f"table {self.number} asks a detector", remedy="Give an ONNX or TFLite file by --detector."
            )
        require_road_users(open_cached_detector(self.detector).class_names, self.detector)

    def _find_inputs(self, protocol: tuple[str, ...]) -> _Inputs:
        """Finds the logs, and what a scene asks for before the user's settings."""
        if self.scene is None:
            if not self.logs:
                raise ConfigError("there is nothing to measure", remedy="Give a log, or for table 2 --scene FILE.")
            return _Inputs(self.logs, self.settings)
        if self.logs:
            raise ConfigError(
                f"there are both a scene and a log ({self.logs[0]})",
                remedy="Leave out one of them: a scene comes with its images and cameras in the place of a log.",
            )
        prepared = prepare_enhancement(self.scene, load_configuration(self.preset, settings=protocol))
        return _Inputs((prepared.log,), (*prepared.settings, *self.settings), prepared.explanation)

    @property
    def command(self) -> str:
        """The command that makes this table again, completely also where this one is of what the store has.

        >>> TableRequest(4, ("synthetic:street",), chunks=(0,)).command
        'genre table 4 synthetic:street --preset small --chunks 0'
        """
        # Neither --out nor --stored: they do not change what the numbers mean.
        scene = [] if self.scene is None else self.scene.list_options()
        parts = ["genre", "table", str(self.number), *self.logs, *scene, "--preset", self.preset]
        if self.detector is not None:
            parts += ["--detector", self.detector]
        if self.chunks is not None:
            parts += ["--chunks", ",".join(map(str, self.chunks))]
        for option, values in (("--set", self.settings), ("--method", self.methods), ("--weights", self.weights)):
            for value in values:
                parts += [option, value]
        if self.into:
            parts += ["--into", self.into]
        return shlex.join(parts)


@dataclass(frozen=True)
class CheckedRequest:
    """A request whose files were read.

    Attributes:
        basis: preset, settings and store.
        layout: the table with the user's rows and weights.
        places: the chunks to measure.
        missing: label of a row → why it cannot be measured.
        dataset: of all logs.
        explanation: a line for each thing that was found or assumed about a scene.
        detector: that table 7 asks.
    """

    basis: Basis
    layout: Layout
    places: tuple[LogChunk, ...]
    missing: dict[str, str]
    dataset: str
    explanation: tuple[str, ...] = ()
    detector: str | None = None

    @property
    def config(self) -> PipelineConfig:
        """The preset with the protocol and the user's settings, without any method's."""
        return load_configuration(self.basis.preset, settings=(*self.layout.protocol, *self.basis.settings))

    def list_jobs(self) -> list[tuple[Job, tuple[str, ...]]]:
        """Lists the job of each cell that can be measured, with its stages."""
        return [
            (self.basis.job(self.layout, row.method, where), tuple(list_stages(self.layout, row.method)))
            for where in self.places
            for row in self.measurable_rows
        ]

    def group_places(self) -> list[tuple[LogChunk, ...]]:
        """Groups the chunks by cell: every chunk alone, or all chunks of a log where the table has rollouts."""
        if not self.layout.rollouts:
            return [(where,) for where in self.places]
        logs = dict.fromkeys(where.log for where in self.places)
        # A recorded path goes through the chunks in the order of the log, however they were named.
        in_order = sorted(self.places, key=lambda where: where.chunk)
        return [tuple(where for where in in_order if where.log == log) for log in logs]

    @property
    def measurable_rows(self) -> tuple[Row, ...]:
        """The rows that can be measured."""
        return tuple(row for row in self.layout.rows if row.label not in self.missing)


def describe_places(places: Sequence[LogChunk]) -> str:
    """Names the chunks of a cell.

    Args:
        places: chunks of one log.

    >>> describe_places([LogChunk("pandaset:002", 0), LogChunk("pandaset:002", 1)])
    'pandaset:002 chunks 0, 1'
    """
    if len(places) == 1:
        return str(places[0])
    return f"{places[0].log} chunks {', '.join(str(where.chunk) for where in places)}"


def predict_table(checked: CheckedRequest) -> list[dict[str, Any]]:
    """Predicts what a table would take, without computing anything.

    Args:
        checked: what to measure.

    Returns:
        The rows of :func:`predict_stages`, and where the table has rollouts one for those of each method and log.
    """
    rows = predict_stages(checked)
    if checked.layout.rollouts:
        rows += [
            predict_rollouts(checked.basis, checked.layout, row.method, places)
            for places in checked.group_places()
            for row in checked.measurable_rows
        ]
    return rows


def predict_stages(checked: CheckedRequest) -> list[dict[str, Any]]:
    """Predicts what the stages of a table would take.

    Args:
        checked: what to measure.

    Returns:
        A row for each method and chunk, see :meth:`flows.experiments.stage_prediction.StagePredictor.predict`; for a
        method that cannot be measured ``cached`` says why.
    """
    predictor = StagePredictor(checked.basis.store)
    rows: list[dict[str, Any]] = []
    for where in checked.places:
        base = PipelineConfig.model_validate(checked.basis.job(checked.layout, PRESET_METHOD, where).config)
        for row in checked.layout.rows:
            # It is listed all the same, so that a dry run shows what the table will lack.
            if row.label in checked.missing:
                reason = f"not measured: {checked.missing[row.label]}"
                rows.append({"cell": row.label, "seconds": 0.0, "cached": reason})
                continue
            # The predictor remembers earlier cells, so that shared stages are counted once.
            job = checked.basis.job(checked.layout, row.method, where)
            names = list_stages(checked.layout, row.method)
            rows.append(predictor.predict(f"{row.label} · {where}", job, base, names))
    return rows


def find_unstored_methods(checked: CheckedRequest) -> dict[str, str]:
    """Finds methods of which the store lacks a stage on any chunk.

    Args:
        checked: what to measure.

    Returns:
        Label of the row → the first stage that is missing, or the log that lacks rollouts, as a sentence.
    """
    unstored: dict[str, str] = {}
    for where in checked.places:
        for row in checked.layout.rows:
            names = list_stages(checked.layout, row.method)
            stored = find_stored_stages(checked.basis.job(checked.layout, row.method, where), names)
            absent = [name for name in names if name not in stored]
            if absent:
                # The first chunk's reason is kept; one is enough to leave the method out.
                unstored.setdefault(row.label, f"the store has no {absent[0]} of {where} yet.")
    if checked.layout.rollouts:
        _find_unstored_rollouts(checked, unstored)
    return unstored


def _find_unstored_rollouts(checked: CheckedRequest, unstored: dict[str, str]) -> None:
    """Adds the methods whose stages are stored and some of whose rollouts are not."""
    for places in checked.group_places():
        for row in checked.measurable_rows:
            # A missing stage is the reason already, and without scenes no rollout can be looked up.
            if row.label in unstored:
                continue
            missing = count_missing_rollouts(checked.basis, checked.layout, row.method, places)
            if missing:
                unstored[row.label] = f"the store has not {missing} of the rollouts of {places[0].log} yet."
