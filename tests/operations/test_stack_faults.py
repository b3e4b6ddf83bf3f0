"""Full disks, lost files, killed workers and a server that hangs: services are found, ended, or name what is wrong."""

from __future__ import annotations

import errno
import os
import shutil
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from flows.operations import ObjectServer, PrefectServer, Service
from flows.operations import object_server as object_module
from flows.operations import stack as stack_module
from flows.operations.stack import Stack, read_client_environment, stop_stack
from flows.operations.state_file import ServiceRecord, read_records, write_records
from genre_tasks.errors import ConfigError, ResourceError
from genre_tasks.process_start import read_start_ticks
from tests.waiting import wait_until


class Sleeper(Service):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder, "sleeper", stop_seconds=2.0)

    def command(self) -> list[str]:
        return ["sleep", "60"]


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of files that are written by half, as on a full disk."""
    names: list[str] = []
    write_text = Path.write_text

    def write(path: Path, text: str, *words: Any, **named: Any) -> int:
        if not any(name in path.name for name in names):
            return write_text(path, text, *words, **named)
        write_text(path, text[: len(text) // 2], *words, **named)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(Path, "write_text", write)
    yield names


def make_record(name: str, url: str = "", is_alive: bool = True) -> ServiceRecord:
    """A record of this process, or of an earlier one with its number."""
    ticks = read_start_ticks(os.getpid())
    assert ticks is not None
    return ServiceRecord(name, os.getpid(), ticks - (not is_alive), "2026-01-01T00:00:00+00:00", url, "log")


def test_a_service_that_a_full_disk_leaves_unrecorded_is_stopped(tmp_path: Path, full_disk: list[str]) -> None:
    write_records(tmp_path, {"server": make_record("server")})
    service = Sleeper(tmp_path / "sleeper")
    full_disk.append("services")
    with pytest.raises(ResourceError, match=r"No space left.*Free space there") as caught:
        Stack(tmp_path)._ensure(service)
    assert caught.value.file == str(tmp_path / "services.json")
    assert service.pid is not None and not service.is_alive()
    # Nothing is left of the attempt, and the record of before is there.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["services.json", "sleeper"]
    assert set(read_records(tmp_path)) == {"server"}
    full_disk.clear()
    try:
        Stack(tmp_path)._ensure(service)
        assert set(read_records(tmp_path)) == {"server", "sleeper"}
        assert stat.S_IMODE((tmp_path / "services.json").stat().st_mode) == 0o600
    finally:
        service.stop()


def test_a_start_that_is_interrupted_before_the_record_stops_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*words: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(stack_module, "write_records", interrupt)
    service = Sleeper(tmp_path / "sleeper")
    with pytest.raises(KeyboardInterrupt):
        Stack(tmp_path)._ensure(service)
    assert service.pid is not None and not service.is_alive()


@pytest.mark.parametrize("content", [None, "", "many"], ids=["missing", "empty", "damaged"])
def test_a_running_service_needs_no_file_of_its_port(tmp_path: Path, content: str | None) -> None:
    write_records(tmp_path, {"server": make_record("server", url="http://127.0.0.1:4711/api")})
    server = PrefectServer(tmp_path / "server")
    if content is not None:
        server.folder.mkdir()
        (server.folder / "port").write_text(content)
    Stack(tmp_path)._ensure(server)
    assert server.url == "http://127.0.0.1:4711/api"
    # It ran before.
    assert server.pid is None


@pytest.mark.parametrize(
    "text",
    ["", "export A=1\nexport B", "export A=1\nexport B='/a b", "export A=1\nexport B=/sto", "export A=1\nexport B\n"],
)
def test_cut_variables_for_clients_are_an_error(tmp_path: Path, text: str) -> None:
    file = tmp_path / "env"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"variables for clients are incomplete.*genre ops up") as caught:
        read_client_environment(file)
    assert caught.value.file == str(file)


def test_a_full_disk_leaves_the_variables_of_before(tmp_path: Path, full_disk: list[str]) -> None:
    stack = Stack(tmp_path)
    stack._write_env({"PREFECT_API_AUTH_STRING": "genre:x", "GENRE_STORE": "/it's"})
    full_disk.append("env")
    with pytest.raises(OSError, match="No space left"):
        stack._write_env({"PREFECT_API_AUTH_STRING": "genre:y", "GENRE_STORE": "/other"})
    assert [path.name for path in tmp_path.iterdir()] == ["env"]
    assert stat.S_IMODE((tmp_path / "env").stat().st_mode) == 0o600
    expected = {"PREFECT_API_AUTH_STRING": "genre:x", "GENRE_STORE": "/it's"}
    assert read_client_environment(tmp_path / "env") == expected


def test_down_ends_the_runs_of_a_worker_that_was_killed(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir()
    link = tmp_path / "link"
    link.symlink_to(state)
    write_records(state, {name: make_record(name, is_alive=False) for name in ("server", "worker-0")})
    child = tmp_path / "child"

    def start(home: Path, script: str) -> subprocess.Popen[bytes]:
        env = {**os.environ, "PREFECT_HOME": str(home)}
        return subprocess.Popen(["sh", "-c", script], env=env, start_new_session=True)

    # As Prefect starts a run, and as a run may start a process.
    run = start(state / "workers" / "worker-0-home", f"setsid sleep 60 & echo $! > {child}; wait")
    other = start(tmp_path / "prefect", "exec sleep 60")
    try:
        wait_until(lambda: child.exists() and bool(child.read_text().strip()), "the run does not start")
        assert stop_stack(link) == ["runs of worker-0"]
        for process in (run.pid, int(child.read_text())):
            assert read_start_ticks(process) is None
        assert other.poll() is None
        assert stop_stack(link) == []
    finally:
        for process in (run, other):
            process.kill()
            process.wait()


def test_deletion_keeps_trainings_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    weights = tmp_path / "training" / "gnet" / "weights.safetensors"
    for file in (weights, tmp_path / "store" / "manifest.json", tmp_path / "server" / "password"):
        file.parent.mkdir(parents=True)
        file.write_text("x")
    stop_stack(tmp_path, delete=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lock", "training"]
    assert weights.exists()
    assert f"trainings are kept in {tmp_path / 'training'}" in caplog.text
    caplog.clear()
    shutil.rmtree(tmp_path / "training")
    stop_stack(tmp_path, delete=True)
    assert not caplog.text


def test_data_that_cannot_be_removed_is_an_error(tmp_path: Path) -> None:
    state = tmp_path / "state"
    (state / "postgres").mkdir(parents=True)
    (state / "postgres" / "password").write_text("secret")
    disk = tmp_path / "disk"
    disk.mkdir()
    # A link to a larger disk is not removed, whoever runs this test.
    (state / "store").symlink_to(disk)
    expected = r"have ended, but data could not be removed: store \(.*symbolic link\).*by hand"
    with pytest.raises(ResourceError, match=expected) as caught:
        stop_stack(state, delete=True)
    assert caught.value.file == str(state)
    assert not (state / "postgres").exists() and disk.exists()


def test_an_object_server_that_hangs_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def hang(words: list[str], timeout: float, **named: Any) -> None:
        raise subprocess.TimeoutExpired(words, timeout)

    monkeypatch.setattr(object_module, "find_weed", lambda: "weed")
    server = ObjectServer(tmp_path)
    server.prepare()
    monkeypatch.setattr(object_module.subprocess, "run", hang)
    with pytest.raises(ResourceError, match=r"not made the bucket genre within 60 s.*Read the log") as caught:
        server.finish_start()
    assert caught.value.file == str(server.log)
