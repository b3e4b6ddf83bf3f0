"""Services of the benchmarks of scale: what is deployed on them, without any of them running."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any

import pytest

from benchmarks.scale import cluster_services, deployment


class NoService(AbstractContextManager["NoService"]):
    """A server or worker that is never started."""

    url = "http://127.0.0.1:4200/api"
    store = "s3://store"

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def env(self) -> dict[str, str]:
        return {"PREFECT_API_AUTH_STRING": "name:password"}


@pytest.mark.parametrize(
    ("module", "start"),
    [
        pytest.param(deployment, lambda: deployment.start_deployment(workers=0), id="deployment"),
        pytest.param(cluster_services, cluster_services.start_services, id="cluster"),
    ],
)
def test_trainings_have_a_folder_of_their_own(
    module: ModuleType, start: Callable[[], AbstractContextManager[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("PostgresServer", "PrefectServer", "ObjectServer", "Worker"):
        monkeypatch.setattr(module, name, NoService, raising=False)
    folders: list[Path] = []
    monkeypatch.setattr(module, "deploy_flows", lambda *_, training_folder: folders.append(training_folder))
    with start() as services:
        assert folders == [services.folder / "training"]
