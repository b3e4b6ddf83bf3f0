"""Writes the report of a finished run again, from its record and its artifacts: something was added to the run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from flows.pipeline.stage_runner import ArtifactRef
from flows.reconstruction.report.writing import write_report
from flows.reconstruction.run_records import FinishedRun, find_run_record, name_run_folder, summarise_run
from genre_tasks.errors import InputError
from storage.opening import open_store
from storage.store import Artifact


def rewrite_report(store: str, run: str) -> Path:
    """Writes a run's report over the one that is there; nothing is computed.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.

    Returns:
        The report.

    Raises:
        InputError: there is no such run, or one of its artifacts is gone.
        ArtifactCorruptError: an artifact that the report shows is damaged.
        OSError: the report cannot be written.
    """
    finished = read_finished_run(store, find_run_record(store, run))
    report = write_report(finished.folder / "report.html", summarise_run(finished))
    open_store(store).records.push(name_run_folder(finished.name))
    return report


def read_finished_run(store: str, record: dict[str, Any]) -> FinishedRun:
    """Finds the artifacts of a recorded run.

    Args:
        store: folder (or URI) of the store that the record is from.
        record: as :func:`flows.reconstruction.run_records.find_run_record` returns it.

    Returns:
        The run, as it was when it ended.

    Raises:
        InputError: an artifact is gone.
    """
    wanted = {stage["key"] for chunk in record["chunks"] for stage in chunk["stages"]}
    artifacts = {a.manifest.key: a for a in open_store(store).artifacts() if a.manifest.key in wanted}
    chunks = {}
    notes = {}
    for chunk in record["chunks"]:
        refs = {stage["stage"]: _make_ref(stage, artifacts.get(stage["key"]), record) for stage in chunk["stages"]}
        chunks[chunk["chunk"]] = refs
        # The record holds both in one list; what the log lacks is read from the chunk's artifact again.
        issues = [str(i) for i in artifacts[refs["ingest"].key].manifest.measurements.get("marks", ())]
        for warning in chunk.get("warnings", ()):
            if warning not in issues:
                notes[chunk["chunk"]] = warning
                break
    return FinishedRun(
        log=record["log"],
        preset=record["preset"],
        store=store,
        config=record["config"],
        differs={key: (values[0], values[1]) for key, values in record["differs"].items()},
        chunks=chunks,
        notes=notes,
        left_out=record.get("left_out", ()),
    )


def _make_ref(stage: dict[str, Any], artifact: Artifact | None, record: dict[str, Any]) -> ArtifactRef:
    if artifact is None:
        raise InputError(
            "an artifact of this run is gone", remedy="Run the log again.", log=record["log"], stage=stage["stage"]
        )
    return ArtifactRef(
        stage=stage["stage"],
        key=stage["key"],
        payload_digest=artifact.manifest.payload_digest,
        address=artifact.address,
        cached=stage["cached"],
    )
