"""Pool, queues and deployments on a Prefect server that others deploy to as well."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from prefect.exceptions import ObjectAlreadyExists

from flows.operations import deployments


class FakeClient:
    """A server on which another command makes the pool just after this one has asked for it."""

    def __init__(self) -> None:
        self.queues: list[str] = []

    def __enter__(self) -> FakeClient:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def read_work_pools(self) -> list[Any]:
        return []

    def create_work_pool(self, pool: Any) -> None:
        raise ObjectAlreadyExists(RuntimeError(f"{pool.name} exists"))

    def create_work_queue(self, name: str, work_pool_name: str) -> None:
        self.queues.append(f"{work_pool_name}/{name}")


def test_a_pool_that_another_deployment_has_just_made_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    client = FakeClient()
    monkeypatch.setattr("prefect.client.orchestration.get_client", lambda sync_client: client)
    monkeypatch.setattr(deployments, "DEPLOYMENTS", ())
    monkeypatch.setattr(deployments, "install_heartbeat_automation", lambda url, auth: "")
    assert deployments.deploy_flows("http://127.0.0.1:1/api", None, "genre", "store", training_folder=tmp_path) == []
    assert client.queues == ["genre/datasets"]
