"""``genre serve``: the command with its address, counters and end, and one clear error for each mistake."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from flows.simulators import protocols
from flows.simulators.http_thread import _FURTHER_CONNECTIONS, HttpThread
from flows.simulators.image_request import RenderLimits
from flows.simulators.neuroncap import start_neuroncap
from flows.simulators.protocols import ProtocolEntry, load_protocol
from flows.simulators.scene_renderer import SceneRenderer
from flows.simulators.service import ServiceRequest, bind_socket, is_loopback
from flows.simulators.service_metrics import PrometheusMetrics, SilentMetrics
from genre_tasks.errors import ConfigError, GenreError, InputError
from tests.flows.command_line import GENRE, environment
from tests.waiting import wait_until


def read(address: str) -> str:
    with urllib.request.urlopen(address, timeout=60) as answer:
        text: str = answer.read().decode()
        return text


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_service_answers_until_a_signal(number: signal.Signals, served: tuple[str, str], tmp_path: Path) -> None:
    store, run = served
    command = [*GENRE, "serve", run[:6], "--store", store, "--port", "0", "--metrics-port", "0"]
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell that runs the tests in the background has them ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        assert process.stdout is not None and process.stderr is not None
        counters = process.stdout.readline().split()[-1]
        assert process.stdout.readline().startswith(f"scene {run}: 2 cameras, 7 actors, ")
        last = process.stdout.readline()
        assert last.startswith("serving neuroncap at http://127.0.0.1:") and last.endswith(" until Ctrl-C\n")
        address = last.split()[3]
        assert json.loads(read(f"{address}/alive")) is True
        assert 'genre_requests_total{method="alive",status="200"} 1.0' in read(counters)
        process.send_signal(number)
        assert process.wait(30) == 128 + number
        assert process.stderr.read() == "stopped\n"
    finally:
        process.kill()
        process.communicate()
    with pytest.raises(OSError, match="refused"):
        read(f"{address}/alive")


def ask_for_image(address: str, message: bytes) -> tuple[int, Mapping[str, str], bytes]:
    request = urllib.request.Request(f"{address}/render_image", message)
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, answer.headers, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read()


def test_as_many_requests_wait_as_the_queue_takes(served: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    # More than a thread pool of 40 and 64 connections would let wait.
    renderer = SceneRenderer(*served, limits=RenderLimits(max_waiting=70))
    release = threading.Event()
    render = renderer._render
    monkeypatch.setattr(renderer, "_render", lambda requests: release.wait(60) and render(requests))
    camera = renderer.cameras["front_camera"]
    pose = renderer.ego_trajectory()[1][2] @ camera.rig_SE3_camera
    timestamp = round(renderer.ego_trajectory()[0][2] * 1e6)
    fields = {"pose": pose.tolist(), "timestamp": timestamp, "camera_name": camera.name, "image_format": "png"}
    message = json.dumps(fields).encode()
    service = start_neuroncap(ServiceRequest({renderer.name: renderer}, "127.0.0.1", 0, SilentMetrics()))
    try:
        with ThreadPoolExecutor(71) as pool:
            asked = [pool.submit(ask_for_image, service.address, message) for _ in range(71)]
            deadline = time.monotonic() + 30
            while renderer.queue_length < 71 and time.monotonic() < deadline:
                time.sleep(0.02)
            try:
                assert renderer.queue_length == 71
                status, headers, body = ask_for_image(service.address, message)
                assert read(f"{service.address}/alive") == "true"
            finally:
                # Also after a failure: the pool waits for all that were asked.
                release.set()
        assert (status, headers["Retry-After"]) == (503, "1")
        assert "70 requests wait, and 70 may" in json.loads(body)["detail"]
        assert {answer.result()[0] for answer in asked} == {200}
    finally:
        service.close()


def test_far_more_connections_than_may_wait_are_refused_unread() -> None:
    asked: list[str] = []

    async def answer(scope: dict[str, Any], receive: Any, send: Callable[[dict[str, Any]], Awaitable[None]]) -> None:
        asked.append(scope["path"])
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"0")]})
        await send({"type": "http.response.body"})

    def ask(path: str) -> int:
        with socket.create_connection(address, timeout=30) as client:
            client.sendall(f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
            return int(client.recv(100).split()[1])

    service = HttpThread(answer, "127.0.0.1", 0, max_waiting=0)
    address = "127.0.0.1", int(service.address.rpartition(":")[2])
    try:
        with ExitStack() as idle:
            for _ in range(_FURTHER_CONNECTIONS - 2):
                idle.enter_context(socket.create_connection(address, timeout=30))
            assert ask("/last") == 200
            for _ in range(2):
                idle.enter_context(socket.create_connection(address, timeout=30))
            assert ask("/refused") == 503
        wait_until(lambda: ask("/later") == 200, "closed connections still count")
        assert asked == ["/last", "/later"]
    finally:
        service.close()


def refusal(*words: str) -> GenreError:
    error = CliRunner().invoke(app, ["serve", *words]).exception
    assert isinstance(error, GenreError)
    return error


def test_mistakes_are_named(served: tuple[str, str]) -> None:
    store, run = served
    assert "Did you mean 'neuroncap'" in str(refusal(run, "--store", store, "--protocol", "neuroncp"))
    assert "--port 70000 is out of range" in str(refusal(run, "--store", store, "--port", "70000"))
    assert "--max-width 0 is out of range" in str(refusal(run, "--store", store, "--max-width", "0"))
    assert "--queue 257 is out of range" in str(refusal("nosuchrun", "--store", store, "--queue", "257"))
    assert isinstance(refusal("nosuchrun", "--store", store, "--port", "0"), InputError)
    assert isinstance(refusal(run, "--store", store, "--port", "0", "--stage", "enet"), InputError)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert "cannot listen at 127.0.0.1" in str(refusal(run, "--store", store, "--port", port))
        words = (run, "--store", store, "--port", "0", "--metrics-port", port)
        assert "another --metrics-port" in str(refusal(*words))
    assert "no.such.host" in str(refusal(run, "--store", store, "--port", "0", "--host", "no.such.host.invalid"))


def test_an_address_is_taken_at_once() -> None:
    with bind_socket("127.0.0.1", 0) as one, pytest.raises(ConfigError, match="--port"):
        bind_socket("127.0.0.1", one.getsockname()[1])
    assert [is_loopback(host) for host in ("localhost", "::1", "127.9.9.9", "::", "example.org")] == [
        *(True, True, True, False, False)
    ]


def test_counters() -> None:
    metrics = PrometheusMetrics("127.0.0.1", 0, lambda: 3)
    metrics.count_request("render", "ok", 0.03)
    metrics.count_images(6)
    text = read(f"http://127.0.0.1:{metrics.port}/metrics")
    for line in (
        'genre_requests_total{method="render",status="ok"} 1.0',
        'genre_request_seconds_bucket{le="0.05",method="render"} 1.0',
        "genre_images_total 6.0",
        "genre_queue 3.0",
    ):
        assert line in text
    metrics.close()


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with pytest.raises(ConfigError, match="prometheus_client"):
        PrometheusMetrics("127.0.0.1", 0, lambda: 0)
    monkeypatch.setitem(protocols._PROTOCOLS, "other", ProtocolEntry("no_such_package.service:start", 1))
    with pytest.raises(ConfigError, match="no_such_package"):
        load_protocol("other")
