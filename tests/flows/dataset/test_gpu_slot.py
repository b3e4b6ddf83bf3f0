"""Slots of a GPU under a real server: a stage that is tried again neither keeps its slot nor loses it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from prefect import flow
from prefect.client.orchestration import get_client
from prefect.client.schemas.actions import GlobalConcurrencyLimitCreate
from prefect.concurrency.asyncio import ConcurrencySlotAcquisitionError
from prefect.settings import PREFECT_API_URL, temporary_settings

from flows.pipeline import stage_task
from flows.pipeline.gpu_slot import GPU_LIMIT_VARIABLE, gpu_slot
from flows.pipeline.stage_runner import ArtifactRef, Job
from genre_tasks.errors import ConfigError, TransientIOError
from tests.faults import small_run

LIMIT = "test-gpu"


def active_slots() -> int:
    with get_client(sync_client=True) as client:
        return client.read_global_concurrency_limit_by_name(LIMIT).active_slots


def test_a_stage_without_a_limit_needs_no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(GPU_LIMIT_VARIABLE, raising=False)
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:9/api")
    entered = []
    with gpu_slot("gnet"):
        entered.append("gnet")
    monkeypatch.setenv(GPU_LIMIT_VARIABLE, LIMIT)
    with gpu_slot("ingest"):
        entered.append("ingest")
    assert entered == ["gnet", "ingest"]


def _refuse(status: int) -> httpx.HTTPStatusError:
    request = httpx.Request("POST", "http://127.0.0.1:9/api")
    return httpx.HTTPStatusError("refused", request=request, response=httpx.Response(status, request=request))


@pytest.mark.parametrize(
    ("causes", "error", "tries"),
    [
        # The server was killed and is started again: the stage waits.
        ([httpx.ConnectError("refused"), _refuse(503)], None, 3),
        # Without a cause, the server says that there is no such limit.
        ([None], ConfigError, 1),
        ([_refuse(422)], ConfigError, 1),
        ([httpx.ConnectError("refused")] * 100, TransientIOError, 35),
    ],
)
def test_a_server_that_is_away_is_no_missing_limit(
    causes: list[Exception | None], error: type[Exception] | None, tries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = list(causes)
    now_s = [0.0]

    @contextmanager
    def concurrency(name: str, **options: Any) -> Iterator[None]:
        if left:
            raise ConcurrencySlotAcquisitionError("no slot") from left.pop(0)
        yield

    def sleep(seconds: float) -> None:
        now_s[0] += seconds

    monkeypatch.setenv(GPU_LIMIT_VARIABLE, LIMIT)
    monkeypatch.setattr("prefect.concurrency.sync.concurrency", concurrency)
    monkeypatch.setattr("flows.pipeline.gpu_slot.time", SimpleNamespace(monotonic=lambda: now_s[0], sleep=sleep))
    entered = []
    with nullcontext() if error is None else pytest.raises(error), gpu_slot("gnet"):
        entered.append(True)
    assert entered == ([True] if error is None else [])
    assert len(causes) - len(left) + (error is None) == tries


@pytest.mark.slow
def test_a_retried_stage_returns_its_slot_and_takes_it_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[int] = []

    def fails_once(stage: str, job: Job, *args: Any, slot: Any, **kwargs: Any) -> ArtifactRef:
        with slot():
            taken.append(active_slots())
            if len(taken) == 1:
                raise TransientIOError("the store is away", remedy="Wait.")
        return ArtifactRef(stage, "key", "digest", "path", cached=False)

    @flow
    def one_stage() -> Any:
        return stage_task.stage_task("gnet", 0, Job(small_run.LOG, 0, str(tmp_path), {}), {})

    def hold_slot(is_held: threading.Event) -> None:
        with temporary_settings({PREFECT_API_URL: url}), gpu_slot("enet"):
            is_held.set()
            time.sleep(3)

    monkeypatch.setattr(stage_task, "run_stage", fails_once)
    monkeypatch.setenv(GPU_LIMIT_VARIABLE, LIMIT)
    with small_run.prefect_server(tmp_path) as url, temporary_settings({PREFECT_API_URL: url}):
        with pytest.raises(ConfigError, match="no concurrency limit"), gpu_slot("gnet"):
            pass
        with get_client(sync_client=True) as client:
            client.create_global_concurrency_limit(GlobalConcurrencyLimitCreate(name=LIMIT, limit=1))
        is_held = threading.Event()
        other = threading.Thread(target=hold_slot, args=(is_held,))
        other.start()
        assert is_held.wait(30)
        ref: ArtifactRef = one_stage(return_state=True).result()
        assert ref.key == "key"
        other.join()
        # One slot in use at both tries, by this stage alone, and none afterwards.
        assert taken == [1, 1]
        assert active_slots() == 0
