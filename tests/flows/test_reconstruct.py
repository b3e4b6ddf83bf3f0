"""The flows under Prefect: cached states, retries, and failures that do not take others along."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from flows.pipeline import stage_task
from flows.pipeline.definition import PIPELINE
from flows.pipeline.log_cache import cached_log, expand_logs
from flows.pipeline.stage_runner import Job
from flows.reconstruction import flow, run_records
from genre_tasks.errors import ConfigError, InputError, ResourceError, TransientIOError
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


def test_a_hit_ends_in_a_state_named_cached(tmp_path: Path) -> None:
    summary = run(tmp_path)
    job = Job(LOG, 0, str(tmp_path), summary["config"])
    state = stage_task.stage_task("ingest", 0, job, {}, return_state=True)
    assert (state.name, state.type.value) == ("Cached", "COMPLETED")


@pytest.mark.parametrize("kind", [ResourceError, TransientIOError])
def test_what_a_retry_can_cure_is_retried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type) -> None:
    attempts: list[int] = []
    monkeypatch.setattr(stage_task.stage_task, "retry_delay_seconds", 0)
    real = stage_task.run_stage

    def failing(stage: str, job: Job, inputs: Any, attempt: int, progress: Any) -> Any:
        attempts.append(attempt)
        if stage == "initial" and len(attempts) < 5:
            raise kind("not now", remedy="Wait.")
        return real(stage, job, inputs, attempt, progress)

    monkeypatch.setattr(stage_task, "run_stage", failing)
    assert served(run(tmp_path)) == [False] * 3
    assert attempts == [0, 0, 0, 1, 2]


def test_what_no_retry_can_cure_is_not_retried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []

    def failing(stage: str, *args: Any, **kwargs: Any) -> Any:
        calls.append(stage)
        raise ConfigError("wrong", remedy="Mend it.")

    monkeypatch.setattr(stage_task, "run_stage", failing)
    with pytest.raises(ConfigError, match="wrong"):
        run(tmp_path)
    assert calls == ["ingest"]


def test_a_chunk_that_cannot_be_made_leaves_the_others(tmp_path: Path) -> None:
    settings = [*SETTINGS, "ingest.chunk_frames=6", "ingest.source_every=2"]
    log = LOG.replace("frames=8", "frames=7")  # the second chunk has one frame, hence one source view
    with pytest.raises(InputError, match="source"):
        flow.reconstruct_log(log, preset="demo", store=str(tmp_path), settings=settings)
    (record,) = run_records.list_runs(str(tmp_path))
    assert [c["chunk"] for c in record["chunks"]] == [0]


def test_a_log_that_fails_does_not_stop_the_dataset(tmp_path: Path) -> None:
    logs = ["synthetic:nothing", LOG, OTHER_LOG]
    with pytest.raises((InputError, ConfigError), match="nothing"):
        flow.reconstruct_dataset(logs, preset="demo", store=str(tmp_path), settings=list(SETTINGS))
    assert {r["log"] for r in run_records.list_runs(str(tmp_path))} == {LOG, OTHER_LOG}


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
    number, chunk = run_records.read_stage_value(str(tmp_path), summary["run"][:6], None, "ingest")
    assert number == 0 and chunk.log == cached_log(LOG).name
    shutil.rmtree(next(tmp_path.glob("synthetic/*/0000/initial")))
    with pytest.raises(InputError, match="gone"):
        run_records.read_stage_value(str(tmp_path), summary["run"], 0, "initial")
