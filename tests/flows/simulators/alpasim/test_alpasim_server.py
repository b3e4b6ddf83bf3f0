"""The server: several clients at once, bounds, faults, and its end."""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest

from flows.simulators.alpasim import common_pb2, sensorsim_pb2
from flows.simulators.alpasim.server import SensorServer
from flows.simulators.alpasim.start import start_alpasim
from flows.simulators.image_request import RenderLimits
from flows.simulators.protocols import load_protocol
from flows.simulators.scene_renderer import SceneRenderer
from flows.simulators.service import ServiceRequest
from genre_tasks.errors import ConfigError, ResourceError
from tests.flows.simulators.alpasim.wire_client import ServedRun, WireClient
from tests.flows.simulators.held_renders import hold_renders
from tests.waiting import wait_until


class FakeService:
    """Answers every call with what a function does."""

    def __init__(self, answer: Callable[[], None]) -> None:
        self._answer = answer

    def get_version(self, _: Any) -> common_pb2.VersionId:
        self._answer()
        return common_pb2.VersionId(version_id="fake")


@contextmanager
def serve(answer: Callable[[], None], **options: Any) -> Iterator[tuple[SensorServer, WireClient]]:
    pytest.importorskip("grpc")
    with SensorServer(FakeService(answer), **options) as server, WireClient(server.address) as client:  # type: ignore[arg-type]
        yield server, client


def test_two_clients_get_their_own_images(client: WireClient, served: ServedRun) -> None:
    requests = [client.image_request(k % 2, step) for k, step in enumerate(range(8))]
    expected = [client.call("render_rgb", request).image_bytes for request in requests]
    with SensorServer(served.service) as server, WireClient(server.address) as one, WireClient(server.address) as two:

        def drive(simulator: WireClient) -> list[bytes]:
            return [simulator.call("render_rgb", request).image_bytes for request in requests]

        with ThreadPoolExecutor(2) as pool:
            assert list(pool.map(drive, [one, two])) == [expected, expected]


class CountingMetrics:
    """Counts calls by method and status; a ``ServiceMetrics``."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self.images = 0

    def count_request(self, method: str, status: str, seconds: float) -> None:
        assert seconds > 0
        self.counts[method, status] += 1

    def count_images(self, count: int) -> None:
        self.images += count


def test_calls_are_counted_by_method_and_status() -> None:
    metrics = CountingMetrics()
    with serve(lambda: None, metrics=metrics) as (_, client):
        client.call("get_version")
        client.status("get_version", b"\xff")
        client.status("get_version", b"")
    assert metrics.counts == {("get_version", "OK"): 2, ("get_version", "INVALID_ARGUMENT"): 1}


def test_a_service_of_runs_is_started_and_counts_images(served: ServedRun) -> None:
    metrics = CountingMetrics()
    renderers = {served.renderer.name: served.renderer}
    service = start_alpasim(ServiceRequest(renderers, "127.0.0.1", 0, metrics))
    with WireClient(service.address) as client:
        client.render(client.image_request())
        batch = sensorsim_pb2.BatchRGBRenderRequest()
        for k in range(2):
            batch.items.add(camera_name=str(k), request=client.image_request(k))
        client.call("batch_render_rgb", batch)
    service.close()
    assert metrics.images == 3
    assert metrics.counts["batch_render_rgb", "OK"] == 1


def test_as_many_calls_wait_as_the_queue_takes(served: ServedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = SceneRenderer(served.store, served.run, limits=RenderLimits(max_waiting=80))
    release = threading.Event()
    render = renderer._render
    monkeypatch.setattr(renderer, "_render", lambda requests: release.wait(60) and render(requests))
    service = start_alpasim(ServiceRequest({renderer.name: renderer}, "127.0.0.1", 0, CountingMetrics()))
    try:
        with WireClient(service.address) as client, ThreadPoolExecutor(81) as pool:
            payload = client.image_request().SerializeToString()
            calls = [pool.submit(client.status, "render_rgb", payload) for _ in range(81)]
            deadline = time.monotonic() + 30
            while renderer.queue_length < 81 and time.monotonic() < deadline:
                time.sleep(0.02)
            try:
                assert renderer.queue_length == 81
                status, details = client.status("render_rgb", payload)
            finally:
                # Also after a failure: the pool waits for all that were asked.
                release.set()
            assert {call.result()[0] for call in calls} == {"OK"}
        assert status == "RESOURCE_EXHAUSTED" and "80 requests wait, and 80 may" in details
    finally:
        service.close()


def test_nobody_renders_for_a_client_that_has_gone(served: ServedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = SceneRenderer(served.store, served.run)
    held = hold_renders(renderer, monkeypatch)
    service = start_alpasim(ServiceRequest({renderer.name: renderer}, "127.0.0.1", 0, CountingMetrics()))
    try:
        with WireClient(service.address) as patient, ThreadPoolExecutor(1) as pool:
            payload = patient.image_request().SerializeToString()
            first = pool.submit(patient.status, "render_rgb", payload)
            wait_until(lambda: renderer.queue_length == 1, "the first call does not come")
            with WireClient(service.address) as hasty:
                call = hasty.start("render_rgb", payload)
                wait_until(lambda: renderer.queue_length == 2, "the second call does not come")
                call.cancel()
            # The server hears of it a moment later.
            time.sleep(1.5)
            held.release.set()
            assert first.result(60)[0] == "OK"
            wait_until(lambda: renderer.queue_length == 0, "the second call does not end")
        assert held.rendered == [1]
    finally:
        held.release.set()
        service.close()


def test_genre_serve_knows_the_protocol() -> None:
    assert load_protocol("alpasim") is start_alpasim


def test_more_calls_than_may_wait_are_refused() -> None:
    release = threading.Event()
    with serve(lambda: release.wait(30) and None, max_waiting=0) as (_, client):
        with ThreadPoolExecutor(20) as pool:
            calls = [pool.submit(client.status, "get_version", b"") for _ in range(20)]
            deadline = time.monotonic() + 30
            while sum(call.done() for call in calls) < 12 and time.monotonic() < deadline:
                time.sleep(0.01)
            refused = [call.result()[0] for call in calls if call.done()]
            release.set()
        codes = Counter(call.result()[0] for call in calls)
        assert refused == ["RESOURCE_EXHAUSTED"] * 12
        assert codes == {"RESOURCE_EXHAUSTED": 12, "OK": 8}
        assert client.status("get_version", b"")[0] == "OK"


def test_a_fault_of_the_program_says_nothing_of_itself_to_clients(caplog: pytest.LogCaptureFixture) -> None:
    def fail() -> None:
        raise ZeroDivisionError("a secret")

    with serve(fail) as (_, client):
        code, details = client.status("get_version", b"")
    assert code == "INTERNAL"
    assert "secret" not in details
    assert "a secret" in caplog.text


def test_a_busy_renderer_asks_to_come_back() -> None:
    def refuse() -> None:
        raise ResourceError("the renderer is busy", remedy="Ask again later.")

    with serve(refuse) as (_, client):
        assert client.status("get_version", b"") == ("RESOURCE_EXHAUSTED", "the renderer is busy. Ask again later.")


def test_the_end_lets_calls_under_way_finish() -> None:
    started = threading.Event()
    release = threading.Event()

    def answer() -> None:
        started.set()
        release.wait(30)

    with serve(answer) as (server, client), ThreadPoolExecutor(2) as pool:
        call = pool.submit(client.status, "get_version", b"")
        assert started.wait(30)
        end = pool.submit(server.close, 30.0)
        time.sleep(0.05)
        assert not end.done()
        release.set()
        end.result(30)
        assert call.result(30)[0] == "OK"
        assert client.status("get_version", b"")[0] == "UNAVAILABLE"
        # The port is free again.
        host, _, port = server.address.rpartition(":")
        SensorServer(FakeService(lambda: None), host, int(port)).close()  # type: ignore[arg-type]


def test_a_taken_port_is_named() -> None:
    with serve(lambda: None) as (server, _):
        host, _, port = server.address.rpartition(":")
        with pytest.raises(ConfigError, match=f"cannot listen on {server.address}"):
            SensorServer(FakeService(lambda: None), host, int(port))  # type: ignore[arg-type]


def test_an_address_of_ipv6_is_served() -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("this machine has no IPv6")
    with serve(lambda: None, host="::1") as (server, client):
        assert server.address.startswith("[::1]:")
        assert client.call("get_version").version_id == "fake"


def test_an_address_of_no_one_is_named() -> None:
    with pytest.raises(ConfigError, match="cannot listen on"):
        SensorServer(FakeService(lambda: None), "192.0.2.1", 0)  # type: ignore[arg-type]


def test_only_this_machine_reaches_the_default_address() -> None:
    with serve(lambda: None) as (server, _):
        assert server.address.startswith("127.0.0.1:")
