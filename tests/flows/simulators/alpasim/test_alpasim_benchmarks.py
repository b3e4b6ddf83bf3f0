"""The benchmarks of the sensor service, on a small run."""

from __future__ import annotations

import pytest

from benchmarks.common.bench import NotMeasuredError
from benchmarks.exchange import service, service_report, simulator_client
from benchmarks.exchange.alpasim_client import AlpasimClient
from benchmarks.exchange.service_fuzz import measure_service_fuzz
from flows.simulators.alpasim.server import SensorServer
from tests.flows.simulators.alpasim.wire_client import ServedRun


def test_malformed_requests_bring_out_no_fault(served: ServedRun) -> None:
    with SensorServer(served.service) as server:
        client = AlpasimClient(server.address)
        row = measure_service_fuzz(client, requests=300, seed=5)
        client.close()
    assert row["first_faults"] == []
    assert (row["faults"], row["silent_refusals"], row["alive"]) == (0, 0, True)
    assert {"OK", "INVALID_ARGUMENT", "UNIMPLEMENTED"} <= set(row["by_status"])


def test_a_rollout_is_timed_and_compared(served: ServedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (service, simulator_client):
        monkeypatch.setattr(module, "CAMERAS", 2)
    monkeypatch.setattr(service, "IMAGE_PX", (64, 36))
    row = service.measure_service(served.store, served.run, steps=3)
    assert row["failed"] == 0
    assert row["images"] == 12
    assert row["max_difference"] <= 1
    by_id = {claim.id: claim for claim in service_report.service_claims([row])}
    assert by_id["exchange.service_failed"].holds
    assert by_id["exchange.service_difference"].holds
    p95 = by_id["exchange.service_p95"]
    # Images of batches have no time of their own.
    assert (p95.measured, p95.n) == (row["alone_ms"]["p95"], row["alone_ms"]["n"]) and p95.n < row["images"]
    assert len(list(service_report.service_table([row]))) == 3
    assert not any(claim.holds for claim in service_report.service_claims([]))


def test_a_rig_of_two_cameras_is_not_measured(served: ServedRun) -> None:
    with pytest.raises(NotMeasuredError, match="2 cameras"):
        service.measure_service(served.store, served.run, steps=1)
