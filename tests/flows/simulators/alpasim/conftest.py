"""One small run, and one server for all tests that do not end it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.flows.simulators.alpasim.wire_client import ServedRun, WireClient


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> ServedRun:
    pytest.importorskip("grpc")
    return ServedRun.open(tmp_path_factory.mktemp("alpasim"))


@pytest.fixture(scope="session")
def client(served: ServedRun) -> Iterator[WireClient]:
    from flows.simulators.alpasim.server import SensorServer

    with SensorServer(served.service) as server, WireClient(server.address) as client:
        yield client
