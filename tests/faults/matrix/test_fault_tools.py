"""The tools of the fault matrix without services: proxy, hooks, counts, table."""

from __future__ import annotations

import http.client
import http.server
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from flows.machine.resource_usage import measure_usage
from genre_tasks.errors import ResourceError, TransientIOError
from storage.local import LocalStore
from tests.contracts.store_suite import address
from tests.faults.matrix import checks
from tests.faults.matrix.compute_log import Note, count_computations, find_running, measure_recovery, read_notes
from tests.faults.matrix.fault_hooks import ARMED, TAKEN, hook_stage_runner
from tests.faults.matrix.fault_table import FaultRow, find_faults, merge_row
from tests.faults.matrix.faulty_proxy import FaultyProxy
from tests.faults.matrix.machine_faults import build_clock_shift, write_shift
from tests.storage.artifact_values import make

BODY = b"0123456789" * 1000
ROW = FaultRow("a fault", "by hand", "folder", 5, 1, 1, 11, 11, 0, 2, 0, 0, 0, 0, [1.0])


class _Echo(http.server.BaseHTTPRequestHandler):
    received: list[bytes]

    def do_PUT(self) -> None:
        data = self.rfile.read(int(self.headers["Content-Length"]))
        type(self).received.append(data)
        self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def proxy() -> Iterator[FaultyProxy]:
    _Echo.received = []
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), _Echo)
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    with FaultyProxy(server.server_address[1], delay_s=0.3).run() as running:
        yield running
    server.shutdown()
    server.server_close()


def put(proxy: FaultyProxy) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", proxy.port, timeout=10)
    try:
        connection.request("PUT", "/x", BODY)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def test_the_proxy_forwards(proxy: FaultyProxy) -> None:
    assert put(proxy) == (200, BODY)
    assert _Echo.received == [BODY]


def test_the_proxy_answers_503_and_forwards_nothing(proxy: FaultyProxy) -> None:
    proxy.set_mode("503")
    assert put(proxy)[0] == 503
    assert _Echo.received == [] and proxy.hits["503"] == 1


def test_the_proxy_is_slow(proxy: FaultyProxy) -> None:
    proxy.set_mode("slow")
    start_s = time.monotonic()
    assert put(proxy) == (200, BODY)
    assert time.monotonic() - start_s >= 0.3


def test_the_proxy_refuses_and_listens_again_at_its_port(proxy: FaultyProxy) -> None:
    port = proxy.port
    proxy.set_mode("refuse")
    with pytest.raises(ConnectionRefusedError):
        put(proxy)
    proxy.set_mode("ok")
    assert proxy.port == port and put(proxy) == (200, BODY)


def test_the_proxy_cuts_one_upload_off(proxy: FaultyProxy) -> None:
    proxy.set_mode("truncate")
    with pytest.raises((ConnectionError, http.client.HTTPException)):
        put(proxy)
    assert put(proxy) == (200, BODY)
    # The server has received at most the half, which its handler reads as less than the announced length.
    assert proxy.hits["truncate"] == 1 and all(len(data) in (0, len(BODY) // 2, len(BODY)) for data in _Echo.received)


def test_hooks_note_computations_and_an_armed_fault_hits_once(tmp_path: Path) -> None:
    for name in (ARMED, TAKEN):
        (tmp_path / name).mkdir()
    (tmp_path / ARMED / "memory.1").touch()
    (tmp_path / ARMED / "transient@gnet.2").touch()
    runner = ModuleType("runner")

    def compute(*args: object) -> str:
        with runner.measure_usage():
            return "artifact"

    runner.measure_usage = measure_usage  # type: ignore[attr-defined]
    runner._compute_artifact = compute  # type: ignore[attr-defined]
    hook_stage_runner(tmp_path, runner)

    def run(stage: str) -> object:
        job = SimpleNamespace(log="synthetic:a", store="store")
        return runner._compute_artifact(SimpleNamespace(name=stage), job, {}, None, SimpleNamespace(key=stage * 2))

    with pytest.raises(ResourceError, match="memory ran out"):
        run("ingest")
    assert run("ingest") == "artifact"
    with pytest.raises(TransientIOError):
        run("gnet")
    assert run("gnet") == "artifact"
    notes = read_notes(tmp_path, "store")
    assert [note.event for note in notes] == ["start", "fault", "failed", "start", "done"] * 2
    assert [note.stage for note in notes] == ["ingest"] * 5 + ["gnet"] * 5
    assert {path.name for path in (tmp_path / TAKEN).iterdir()} == {"memory.1", "transient@gnet.2"}
    assert not list((tmp_path / ARMED).iterdir())


def test_a_shifted_clock_jumps_and_waits_do_not(tmp_path: Path) -> None:
    shift = tmp_path / "shift"
    write_shift(shift, 0)
    script = (
        "import os, struct, sys, threading, time, datetime\n"
        "handle = os.open(sys.argv[1], os.O_WRONLY)\n"
        "before = time.time()\n"
        "monotonic = time.monotonic()\n"
        "os.pwrite(handle, struct.pack('=q', -3600), 0)\n"
        "assert -3601 < time.time() - before < -3590\n"
        "assert -3601 < datetime.datetime.now().timestamp() - before < -3590\n"
        "time.sleep(0.01)\n"
        "assert not threading.Event().wait(0.01)\n"
        "assert 0 < time.monotonic() - monotonic < 60\n"
    )
    env = os.environ | {"LD_PRELOAD": str(build_clock_shift(tmp_path)), "GENRE_CLOCK_SHIFT": str(shift)}
    subprocess.run([sys.executable, "-c", script, str(shift)], env=env, check=True)


def test_computations_are_counted_by_key() -> None:
    notes = [
        Note(1.0, "start", 1, "a", "ingest", "one"),
        Note(2.0, "start", 2, "a", "ingest", "one"),
        Note(3.0, "done", 2, "a", "ingest", "one"),
        Note(4.0, "start", 2, "b", "gnet", "two"),
        Note(5.0, "failed", 2, "b", "gnet", "two"),
        Note(6.0, "start", 2, "b", "gnet", "two"),
        Note(7.0, "done", 2, "b", "gnet", "two"),
    ]
    counted = count_computations(notes)
    assert (counted.computed, counted.twice, counted.cut_short, counted.failed) == (2, 0, 1, 1)
    again = count_computations([*notes, Note(8.0, "start", 3, "b", "gnet"), Note(9.0, "done", 3, "b", "gnet")])
    assert again.twice == 1 and again.doubled == ["gnet b"]
    assert find_running(notes, 2.5) == {"one"} and find_running(notes, 4.5) == {"one", "two"}
    assert measure_recovery(notes, 2.5, {"one"}) == 0.5
    assert measure_recovery(notes, 2.5, {"one", "two"}) == 4.5
    assert measure_recovery(notes, 7.5, {"one"}) is None


def test_checks_find_what_is_left_and_what_differs(tmp_path: Path) -> None:
    store = LocalStore(tmp_path)
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    payloads = checks.read_payloads(str(tmp_path))
    assert checks.count_identical(payloads, payloads) == 1
    assert checks.count_identical(dict.fromkeys(payloads, "0"), payloads) == 0
    assert checks.list_leases(store) == [] == checks.list_temporaries(store) == checks.find_damage(str(tmp_path))
    # Of another machine, so that no process can be asked for.
    (artifact.path.parent / ".tmp-0123-00000000-1-1-x").mkdir()
    (tmp_path / ".leases").mkdir(exist_ok=True)
    (tmp_path / ".leases/key.lock").touch()
    next(path for path in artifact.path.iterdir() if path.name != "manifest.json").write_bytes(b"x")
    assert len(checks.list_leases(store)) == len(checks.list_temporaries(store)) == 1
    assert len(checks.find_damage(str(tmp_path))) == 1


def test_the_table_keeps_rows_of_other_faults(tmp_path: Path) -> None:
    path = tmp_path / "data/faults.json"
    for row in (ROW, replace(ROW, fault="another"), replace(ROW, twice=1)):
        merge_row(path, row, "0" * 40)
    rows = json.loads(path.read_text())["rows"]
    assert [(row["fault"], row["twice"]) for row in rows] == [("a fault", 1), ("another", 0)]


@pytest.mark.parametrize(
    "broken",
    [
        {"injected": 4},
        {"complete": 0},
        {"identical": 10},
        {"twice": 1},
        {"slots": 1},
        {"leases": 1},
        {"temporaries": 1},
    ],
)
def test_a_broken_promise_is_found(broken: dict[str, int]) -> None:
    assert find_faults(ROW, 5) == []
    assert len(find_faults(replace(ROW, **broken), 5)) == 1  # type: ignore[arg-type]
