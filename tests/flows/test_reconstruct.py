"""The flows under Prefect: cached states, retries, and failures that do not take others along."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prefect.artifacts import Artifact
from typer.testing import CliRunner

from flows.cli import run as cli_run
from flows.cli.main import app
from flows.dataset.flow import reconstruct_dataset
from flows.pipeline import stage_task
from flows.pipeline.definition import PIPELINE
from flows.pipeline.log_cache import cached_log, expand_logs
from flows.pipeline.stage_runner import Job
from flows.reconstruction import flow, outcome_artifact, run_records, stored_values
from flows.reconstruction.left_out import ChunksLeftOutError, LogsFailedError
from flows.reconstruction.report import writing
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import (
    ArtifactCorruptError,
    ConfigError,
    DiskFullError,
    InputError,
    ResourceError,
    TransientIOError,
    UnsupportedMachineError,
)
from storage.manifest import NewerSchemaError
from tests.faults.small_run import LOG, SETTINGS

OTHER_LOG = LOG.replace("seed=900", "seed=902")


@pytest.fixture(scope="module", autouse=True)
def prefect() -> Iterator[None]:
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=120):
        yield


@pytest.fixture(autouse=True)
def early_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first three stages are enough to see how the flow treats any stage."""
    short = tuple(spec for spec in PIPELINE if spec.name in ("ingest", "effects", "initial"))
    monkeypatch.setattr(flow, "PIPELINE", short)
    monkeypatch.setattr(run_records, "PIPELINE", short)


def run(store: Path, log: str = LOG, **more: Any) -> dict[str, Any]:
    return flow.reconstruct_log(log, preset="demo", store=str(store), settings=list(SETTINGS), **more)


def served(summary: dict[str, Any]) -> list[bool]:
    return [s["cached"] for c in summary["chunks"] for s in c["stages"]]


def test_a_second_run_is_cached_and_says_so(tmp_path: Path) -> None:
    first, second = run(tmp_path), run(tmp_path)
    assert (served(first), served(second)) == ([False] * 3, [True] * 3)
    assert first["run"] == second["run"]
    assert Path(second["report"]).read_text().startswith("<!doctype html>")
    # Prefect's page links to it.
    link = Artifact.get("report")
    assert link is not None and Path(second["report"]).as_uri() in str(link.data) and LOG in str(link.description)


def test_a_hit_ends_in_a_state_named_cached(tmp_path: Path) -> None:
    summary = run(tmp_path)
    job = Job(LOG, 0, str(tmp_path), summary["config"])
    state = stage_task.stage_task("ingest", 0, job, {}, return_state=True)
    assert (state.name, state.type.value) == ("Cached", "COMPLETED")


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        ([ResourceError, ResourceError], [0, 1, 2]),
        # A store that was away for a moment takes no memory.
        ([TransientIOError, TransientIOError], [0, 0, 0]),
        ([TransientIOError, ResourceError, TransientIOError], [0, 0, 1, 1]),
    ],
)
def test_what_a_retry_can_cure_is_retried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kinds: list[type], expected: list[int]
) -> None:
    attempts: list[int] = []
    monkeypatch.setattr(stage_task.stage_task, "retry_delay_seconds", 0)
    real = stage_task.run_stage

    def failing(stage: str, job: Job, inputs: Any, attempt: int, progress: Any, slot: Any) -> Any:
        if stage == "initial":
            attempts.append(attempt)
            if len(attempts) <= len(kinds):
                raise kinds[len(attempts) - 1]("not now", remedy="Wait.")
        return real(stage, job, inputs, attempt, progress, slot)

    monkeypatch.setattr(stage_task, "run_stage", failing)
    assert served(run(tmp_path)) == [False] * 3
    assert attempts == expected


def test_a_runs_log_is_found_from_other_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def compute(log: str, *args: Any) -> dict[str, Any]:
        asked.append(log)
        return {}

    monkeypatch.setattr(flow, "_compute", compute)
    monkeypatch.setattr(cli_run, "check_request", lambda request: None)
    monkeypatch.setattr(cli_run, "reconstruct", lambda request, as_json: asked.append(request.log))
    monkeypatch.chdir(tmp_path)
    run(tmp_path, "genre:007")
    CliRunner().invoke(app, ["run", "genre:007", "--store", str(tmp_path)], catch_exceptions=False)
    assert asked == [f"genre:{tmp_path}/007"] * 2


def test_a_runs_files_are_found_from_other_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str | None] = []

    def compute(log: str, preset: str, store: str, chunks: Any, effective: PipelineConfig, budget: Any) -> dict:
        asked.append(effective.ingest.points)
        return {}

    monkeypatch.setattr(flow, "_compute", compute)
    monkeypatch.setattr(cli_run, "check_request", lambda request: None)
    monkeypatch.setattr(cli_run, "reconstruct", lambda request, as_json: asked.append(request.config.ingest.points))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.ply").touch()
    (tmp_path / "own.yaml").write_text("ingest: {points: p.ply}\n")
    flow.reconstruct_log(LOG, preset="demo", store=str(tmp_path), settings=["ingest.points=p.ply"])
    for words in (["--config", "own.yaml"], ["--set", "ingest={points: p.ply}"]):
        CliRunner().invoke(app, ["run", LOG, "--store", str(tmp_path), *words], catch_exceptions=False)
    assert asked == [str(tmp_path / "p.ply")] * 3


def test_a_chunk_that_failed_by_its_surroundings_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    rows: list[dict[str, Any]] = []
    monkeypatch.setenv(outcome_artifact.DATASET_VARIABLE, "streets")
    monkeypatch.setattr(outcome_artifact, "create_table_artifact", lambda table, **_: rows.extend(table))
    log_at_fault = InputError("no image", remedy="Copy it.")
    passing = (TransientIOError("the store is away", remedy="Wait."), ArtifactCorruptError("altered", remedy="Again."))
    newer = NewerSchemaError("of a newer version", remedy="Update.")
    for error in (log_at_fault, newer, *passing):
        outcome_artifact.publish_outcome(LOG, None, ChunksLeftOutError(LOG, 3, {1: log_at_fault, 2: error}))
        outcome_artifact.publish_outcome(LOG, None, error)
    assert [row["is_passing"] for row in rows] == [False] * 4 + [True] * 4


@pytest.mark.parametrize("kind", [ConfigError, DiskFullError, UnsupportedMachineError])
def test_what_no_retry_can_cure_is_not_retried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type) -> None:
    calls: list[str] = []

    def failing(stage: str, *args: Any, **kwargs: Any) -> Any:
        calls.append(stage)
        raise kind("wrong", remedy="Mend it.")

    monkeypatch.setattr(stage_task, "run_stage", failing)
    with pytest.raises(kind, match="wrong"):
        run(tmp_path)
    assert calls == ["ingest"]


@pytest.mark.parametrize("what", ["write_report", "atomic_path"])
def test_a_disk_that_is_full_when_the_record_is_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    def full(path: Path, *args: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(writing if what == "write_report" else run_records, what, full)
    with pytest.raises(DiskFullError, match="run.json" if what == "atomic_path" else "report.html"):
        run(tmp_path)


def test_a_chunk_that_cannot_be_made_leaves_the_others(tmp_path: Path) -> None:
    settings = [*SETTINGS, "ingest.chunk_frames=6", "ingest.source_every=2"]
    log = LOG.replace("frames=8", "frames=7")  # the second chunk has one frame, hence one source view
    with pytest.raises(ChunksLeftOutError, match=r"1 of 2 chunks left out: chunk 1: .*source") as caught:
        flow.reconstruct_log(log, preset="demo", store=str(tmp_path), settings=settings, chunks=[0, 1])
    (record,) = run_records.list_runs(str(tmp_path))
    assert record == json.loads(json.dumps(caught.value.record))
    assert [c["chunk"] for c in record["chunks"]] == [0]
    (entry,) = record["left_out"]
    assert (entry["class"], entry["chunk"], entry["log"]) == ("InputError", 1, log) and entry["remedy"]
    assert (record["status"], caught.value.status) == ("partly_done", "partly_done")
    assert "chunk 1 is left out" in Path(record["report"]).read_text()


def test_the_end_of_a_log_that_is_too_short_fails_nothing(tmp_path: Path) -> None:
    settings = [*SETTINGS, "ingest.chunk_frames=6", "ingest.source_every=2"]
    log = LOG.replace("frames=8", "frames=7")
    flow.reconstruct_log(log, preset="demo", store=str(tmp_path), settings=settings)
    (record,) = run_records.list_runs(str(tmp_path))
    assert (record["status"], [c["chunk"] for c in record["chunks"]]) == ("done", [0])


@pytest.mark.parametrize(("kind", "status"), [(InputError, "refused"), (ResourceError, "failed")])
def test_all_failures_are_listed_where_no_chunk_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type, status: str
) -> None:
    """Report: none found; case 20 of the list of odd logs."""
    monkeypatch.setattr(stage_task.stage_task, "retry_delay_seconds", 0)

    def failing(stage: str, job: Job, *args: Any, **kwargs: Any) -> Any:
        raise kind(f"reason {job.chunk}", remedy="Mend it.")

    monkeypatch.setattr(stage_task, "run_stage", failing)
    settings = [*SETTINGS, "ingest.chunk_frames=4", "ingest.source_every=2"]
    with pytest.raises(ChunksLeftOutError, match="chunk 0: reason 0; chunk 1: reason 1") as caught:
        flow.reconstruct_log(LOG, preset="demo", store=str(tmp_path), settings=settings)
    assert (caught.value.record, caught.value.status) == (None, status)
    assert [entry["message"] for entry in caught.value.left_out] == ["reason 0", "reason 1"]
    assert not run_records.list_runs(str(tmp_path))


def test_a_dataset_ends_with_a_table_of_all_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports: PrefectHQ/prefect#9193, ploigos/ploigos-step-runner#179."""
    short = LOG.replace("frames=8", "frames=6")
    partly = LOG.replace("frames=8", "frames=9")
    settings = [*SETTINGS, "ingest.chunk_frames=6", "ingest.source_every=2"]
    logs = ["synthetic:nothing", short, partly, OTHER_LOG]
    real = stage_task.run_stage

    def faulty(stage: str, job: Job, *args: Any, **kwargs: Any) -> Any:
        if job.log == OTHER_LOG:
            raise IndexError("list index out of range")
        if (job.log, job.chunk) == (partly, 1):
            raise InputError("too few source frames", remedy="Choose other chunks.")
        return real(stage, job, *args, **kwargs)

    monkeypatch.setattr(stage_task, "run_stage", faulty)
    with pytest.raises(LogsFailedError, match="3 of 4 logs are not complete") as caught:
        reconstruct_dataset(logs, preset="demo", store=str(tmp_path), settings=settings)
    rows = caught.value.outcomes
    assert [row["log"] for row in rows] == logs
    assert [row["status"] for row in rows] == ["failed", "done", "partly_done", "failed"]
    assert "no synthetic log 'nothing'" in rows[0]["why"] and "source" in rows[2]["why"]
    assert "a fault of ours: IndexError" in rows[3]["why"]
    assert (rows[2]["chunks"], rows[2]["left_out"]) == (1, 1)
    for row in rows:
        assert row["log"] in str(caught.value) or row["status"] == "done"
    assert {r["run"] for r in run_records.list_runs(str(tmp_path))} == {rows[1]["run"], rows[2]["run"]}
    # Prefect shows the same table.
    shown = Artifact.get("logs")
    assert shown is not None and json.loads(str(shown.data)) == rows


def test_a_dataset_that_is_done_gives_its_records(tmp_path: Path) -> None:
    records = reconstruct_dataset([LOG, OTHER_LOG], preset="demo", store=str(tmp_path), settings=list(SETTINGS))
    assert [record["log"] for record in records] == [LOG, OTHER_LOG]
    assert {record["status"] for record in records} == {"done"}


def test_an_unknown_chunk_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no chunk 3"):
        run(tmp_path, chunks=[3])


def test_a_folder_of_sequences_is_expanded(tmp_path: Path) -> None:
    for name in ("002", "001"):
        (tmp_path / name).mkdir()
    assert expand_logs([f"pandaset:{tmp_path}/*", LOG]) == [
        f"pandaset:{tmp_path}/001",
        f"pandaset:{tmp_path}/002",
        LOG,
    ]
    with pytest.raises(InputError, match="no log matches"):
        expand_logs([f"pandaset:{tmp_path}/none/*"])


def test_a_stages_value_can_be_had_back(tmp_path: Path) -> None:
    summary = run(tmp_path)
    number, chunk = stored_values.read_stage_value(str(tmp_path), summary["run"][:6], None, "ingest")
    assert number == 0 and chunk.log == cached_log(LOG).name
    shutil.rmtree(next(tmp_path.glob("synthetic/*/0000/initial")))
    with pytest.raises(InputError, match="gone"):
        stored_values.read_stage_value(str(tmp_path), summary["run"], 0, "initial")
