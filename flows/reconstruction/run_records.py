"""Finished runs: their summary, and their record in the store."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows.error_record import describe_record
from flows.pipeline.definition import PIPELINE, RECONSTRUCTION_STAGES
from flows.pipeline.stage_runner import ArtifactRef
from flows.reconstruction.enhancement_check import find_harm
from flows.reconstruction.range_record import read_range_record
from flows.reconstruction.record_files import read_record
from flows.reconstruction.run_summary import (
    ChunkSummary,
    Origin,
    RangeSummary,
    RunSummary,
    StageSummary,
    add_counts,
    place_over_seconds,
)
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import InputError
from storage.io_errors import os_errors_translated
from storage.opening import open_store

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from genre_tasks.metrics.results import Evaluation
    from storage.store import Artifact, Store

_FOLDER = "runs"


@dataclass(frozen=True)
class FinishedRun:
    """A finished run: what was asked for, and the references of every stage of every chunk.

    Attributes:
        log: the log's URI.
        preset: the preset that the run started from.
        store: folder (or URI) of the store.
        config: the whole effective configuration, as JSON values.
        differs: (the preset's value, the value used) of each ``section.key`` that was set otherwise.
        chunks: references by chunk and stage.
        notes: by chunk, what it was made with if that is not what was asked for.
        left_out: of each chunk that could not be reconstructed, its error as plain values with ``chunk``.
    """

    log: str
    preset: str
    store: str
    config: dict[str, Any]
    differs: dict[str, tuple[Any, Any]]
    chunks: dict[int, dict[str, ArtifactRef]]
    notes: Mapping[int, str] = field(default_factory=dict)
    left_out: Sequence[Mapping[str, Any]] = ()

    @property
    def name(self) -> str:
        """Twelve hex digits, the same for runs that made (or found) the same artifacts."""
        # Keys and no time: a run that finds everything in the cache has the same name and replaces its own record.
        keys = {f"{chunk}/{stage}": ref.key for chunk, refs in self.chunks.items() for stage, ref in refs.items()}
        made = [f"{name}={key}" for name, key in sorted(keys.items())]
        # A run that was asked for all chunks and lacks some is not the run of those that it has.
        lacking = [f"{chunk} is left out" for chunk in sorted(str(entry.get("chunk")) for entry in self.left_out)]
        text = "\n".join([self.log, self.preset, *made, *lacking])
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def folder(self) -> Path:
        """The folder of the run's record and report on this machine."""
        return open_store(self.store).records.pull(name_run_folder(self.name))


def write_run_record(run: FinishedRun, summary: RunSummary, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Writes a run's record (``run.json``) and its report (``report.html``) into the store.

    Args:
        run: the finished run.
        summary: what the report shows.
        extra: more entries of the record, such as ``budget``.

    Returns:
        The record, as plain values.

    Raises:
        GenreError: the folder cannot be written.
    """
    from flows.reconstruction.report.writing import write_report

    folder = run.folder
    with os_errors_translated(folder, None):
        folder.mkdir(parents=True, exist_ok=True)
        report = write_report(folder / "report.html", summary)
    record = {
        "status": "partly_done" if run.left_out else "done",
        "log": run.log,
        "preset": run.preset,
        "store": run.store,
        "run": run.name,
        "report": str(report),
        "config": run.config,
        "differs": {key: list(values) for key, values in run.differs.items()},
        "chunks": [
            {
                "chunk": chunk.chunk,
                "warnings": list(chunk.warnings),
                "stages": [_stage_record(stage) for stage in chunk.stages],
            }
            for chunk in summary.chunks
        ],
        "left_out": [dict(entry) for entry in run.left_out],
        **extra,
    }
    # Written last: a folder without run.json belongs to a run that did not end.
    with os_errors_translated(folder, None), atomic_path(folder / "run.json") as part:
        part.write_text(json.dumps(record, indent=1), encoding="utf-8")
    open_store(run.store).records.push(name_run_folder(run.name))
    return record


def summarise_run(run: FinishedRun) -> RunSummary:
    """Gathers what the report and the tables show from the store's manifests and evaluation artifacts.

    Args:
        run: the finished run.

    Returns:
        The summary, chunk by chunk.

    Raises:
        InputError: an artifact of the run is gone.
        ArtifactCorruptError: an evaluation artifact is damaged.
    """
    chunks = tuple(_summarise_chunk(run, chunk, refs) for chunk, refs in sorted(run.chunks.items()))
    return RunSummary(
        run=run.name,
        log=run.log,
        preset=run.preset,
        store=run.store,
        chunks=chunks,
        differs=run.differs,
        left_out=tuple(f"chunk {entry['chunk']} is left out: {describe_record(entry)}" for entry in run.left_out),
        environment=_last_environment(run),
    )


def list_runs(store: str, name: str = "") -> list[dict[str, Any]]:
    """Reads the records of finished runs of a store.

    Args:
        store: folder (or URI) of the store.
        name: how the names of the runs begin; the records of others are not read.

    Returns:
        The records, oldest first.

    Raises:
        InputError: a record is damaged.
    """
    # By the time of the file, which is when the run ended; the record itself holds no time.
    return [read_record(path) for path in open_store(store).records.find(_FOLDER, "run.json", name)]


def _stage_record(stage: StageSummary) -> dict[str, Any]:
    return {
        "stage": stage.stage,
        "key": stage.key,
        "cached": stage.cached,
        "seconds": stage.seconds,
        "peak_mib": stage.peak_mib,
        "metrics": stage.metrics,
    }


def _summarise_chunk(run: FinishedRun, chunk: int, refs: dict[str, ArtifactRef]) -> ChunkSummary:
    store = open_store(run.store)
    artifacts = {name: _find_artifact(store, ref) for name, ref in refs.items()}
    stages = []
    for spec in PIPELINE:
        if spec.name not in artifacts:
            continue
        evaluated = artifacts.get(f"evaluate/{spec.name}")
        evaluation = None if evaluated is None else store.read(evaluated)
        # What counts an artifact's contents reads tables alone.
        store.fetch(artifacts[spec.name], ".parquet")
        stages.append(_summarise_stage(artifacts[spec.name], refs[spec.name].cached, evaluation))
    warnings = [run.notes[chunk]] if chunk in run.notes else []
    # What the log lacks was found once, when the chunk was ingested.
    warnings += [str(issue) for issue in artifacts["ingest"].manifest.measurements.get("marks", ())]
    harm = find_harm(run.config, stages)
    # A run that is read from its record has the warning among its notes.
    if harm is not None and harm not in warnings:
        warnings.append(harm)
    reliable_range: RangeSummary | None = None
    try:
        reliable_range = read_range_record(run.folder, chunk)
    except InputError as error:
        # The run itself is sound: the report says what is wrong with the range, and shows all else.
        warnings.append(str(error))
    return ChunkSummary(
        chunk=chunk,
        stages=tuple(stages),
        warnings=tuple(warnings),
        effects=store.read(artifacts["effects"]).decisions if "effects" in artifacts else (),
        reliable_range=reliable_range,
    )


def _summarise_stage(artifact: Artifact, cached: bool, evaluation: Evaluation | None) -> StageSummary:
    # Here, as it imports NumPy and Arrow, which reading a record does not need.
    from storage.contents import summarise_contents

    manifest = artifact.manifest
    summary = StageSummary(
        stage=manifest.stage,
        key=manifest.key,
        cached=cached,
        seconds=manifest.seconds,
        peak_mib=manifest.peak_mib,
        warnings=manifest.warnings,
        origin=Origin(
            inputs=manifest.inputs,
            payload_digest=manifest.payload_digest,
            size_bytes=sum(file.size for file in manifest.files),
            made_at=manifest.created_at,
            code_digest=manifest.code_digest,
            weights_digest=manifest.weights_digest,
        ),
        contents=summarise_contents(artifact),
    )
    # Stages that make no image, such as ingest, are not evaluated.
    if evaluation is None:
        return summary
    return replace(
        summary,
        metrics=add_counts(evaluation.metrics),
        pictures={name: _encode_png(image) for name, image in evaluation.pictures.items()},
        curve=place_over_seconds(evaluation.curve, manifest.measurements.get("seconds_per_iteration", ())),
        intervals={m.name: (m.low, m.high) for m in evaluation.metrics if m.low is not None and m.high is not None},
    )


def _last_environment(run: FinishedRun) -> Mapping[str, str]:
    for refs in run.chunks.values():
        # Of the first chunk: the others were made by the same command, if not by an earlier one.
        last = [stage for stage in RECONSTRUCTION_STAGES if stage in refs][-1:]
        for stage in last:
            return _find_artifact(open_store(run.store), refs[stage]).manifest.environment
    return {}


def _encode_png(image: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    encoded = io.BytesIO()
    Image.fromarray(image).save(encoded, format="PNG")
    return encoded.getvalue()


def _find_artifact(store: Store, ref: ArtifactRef) -> Artifact:
    artifact = store.find(ref.address)
    if artifact is None:
        raise InputError(
            "an artifact of this run is gone",
            remedy="Run the log again.",
            file=f"{store.uri}/{ref.address}",
            stage=ref.stage,
        )
    return artifact


def find_run_record(store: str, run: str) -> dict[str, Any]:
    """Reads the record of one finished run.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.

    Returns:
        The record, as plain values.

    Raises:
        InputError: no run, or more than one, begins so.
    """
    found = list_runs(store, run)
    # Every name begins with an empty text, which an unset variable of a script's leaves.
    if len(found) != 1 or not run:
        problem = f"{len(found)} runs of this store begin with '{run}'"
        raise InputError(problem, remedy="`genre show runs` lists them.", file=store)
    return found[0]


def find_run_folder(store: str, run: str) -> Path:
    """Finds the folder of a finished run's record and report.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.

    Returns:
        The folder.

    Raises:
        InputError: no run, or more than one, begins so.
    """
    name: str = find_run_record(store, run)["run"]
    return open_store(store).records.pull(name_run_folder(name))


def name_run_folder(run: str) -> str:
    """Names the record folder of a run in a store.

    Args:
        run: the run's full name.

    Returns:
        The name that :class:`storage.records.RecordFolders` takes.

    >>> name_run_folder("5f41c0de9a1b")
    'runs/5f41c0de9a1b'
    """
    return f"{_FOLDER}/{run}"
