"""The services: their commands, secrets, records and errors; one slow test starts all of them for a dataset run."""

from __future__ import annotations

import asyncio
import importlib
import json
import os
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
import yaml
from prefect.settings.models.server.services import ServerServicesSettings
from typer.testing import CliRunner

from flows.cli.main import app
from flows.operations import ObjectServer, PostgresServer, PrefectServer, Service, Worker
from flows.operations import deployments as deployments_module
from flows.operations import object_server as object_module
from flows.operations import postgres_server as postgres_module
from flows.operations import stack as stack_module
from flows.operations.deployments import DEPLOYMENTS, RUN_QUEUE, fill_parameters
from flows.operations.prefect_services import EVENT_SETTINGS
from flows.operations.service import find_free_port, keep_port, keep_secret
from flows.operations.stack import Stack, describe_services, stop_stack
from flows.operations.state_file import ServiceRecord, keep_options, read_records, read_start_ticks, write_records
from flows.prefect_api import connection
from flows.prefect_api.server_thread import DATABASE_VARIABLES
from genre_tasks.errors import ConfigError, ResourceError
from tests.faults import small_run
from tests.waiting import wait_until


class _Sleeper(Service):
    def __init__(self, folder: Path, script: str) -> None:
        super().__init__(folder, "sleeper", start_seconds=5.0, stop_seconds=2.0)
        self.script = script

    def command(self) -> list[str]:
        return ["sh", "-c", self.script]


def _record(pid: int, ticks: int) -> ServiceRecord:
    return ServiceRecord("server", pid, ticks, "2026-01-01T00:00:00+00:00", "http://127.0.0.1:1", "log")


def test_a_service_that_ends_at_its_start_shows_its_log(tmp_path: Path) -> None:
    service = _Sleeper(tmp_path, "echo the-reason >&2; exit 3")
    service.is_healthy = lambda: False  # type: ignore[method-assign]
    with pytest.raises(ResourceError, match="the-reason"):
        service.start()


@pytest.mark.parametrize("session", ["", "setsid "], ids=["same session", "session of its own"])
def test_kill_ends_the_children_too(session: str, tmp_path: Path) -> None:
    service = _Sleeper(tmp_path, f"{session}sleep 60 & echo $! > child; wait")
    service.spawn_options = lambda: {"cwd": tmp_path}  # type: ignore[method-assign]
    service.start()
    child = tmp_path / "child"
    wait_until(lambda: child.exists() and bool(child.read_text().strip()), "the child does not start")
    service.kill()
    deadline = time.monotonic() + 5
    while read_start_ticks(int(child.read_text())) is not None and time.monotonic() < deadline:
        time.sleep(0.02)
    assert read_start_ticks(int(child.read_text())) is None
    assert not service.is_alive()


def test_secrets_stay_and_only_their_user_reads_them(tmp_path: Path) -> None:
    secret = keep_secret(tmp_path / "password")
    assert keep_secret(tmp_path / "password") == secret
    assert stat.S_IMODE((tmp_path / "password").stat().st_mode) == 0o600
    assert len(secret) >= 32


def test_a_port_stays_and_a_taken_one_is_an_error(tmp_path: Path) -> None:
    import socket

    port = keep_port(tmp_path / "port")
    assert keep_port(tmp_path / "port") == port
    with socket.socket() as other:
        other.bind(("127.0.0.1", port))
        other.listen()
        with pytest.raises(ConfigError, match=f"port {port} is taken"):
            keep_port(tmp_path / "port")


def test_commands_hold_no_secret(tmp_path: Path) -> None:
    server = PrefectServer(tmp_path / "server", "postgresql+asyncpg://u:database-secret@127.0.0.1/p", services=False)
    server.folder.mkdir()
    server.prepare()
    secret = server.env()["PREFECT_API_AUTH_STRING"]
    words = server.command() + Worker(tmp_path, server.env(), queue="datasets", limit=1).command()
    assert "--no-services" in words
    assert words[-4:] == ["--work-queue", "datasets", "--limit", "1"]
    assert not any(secret in word or "database-secret" in word for word in words)
    assert Worker(tmp_path, server.env()).environment()["PREFECT_FLOWS_HEARTBEAT_FREQUENCY"] == "30"


def test_all_services_listen_on_the_loopback_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_module, "find_weed", lambda: "weed")
    monkeypatch.setattr(postgres_module, "find_postgres_program", lambda name: name)
    # Its free ports are chosen, and its files written, without its program.
    objects = ObjectServer(tmp_path)
    objects.prepare()
    assert {"-ip=127.0.0.1", "-ip.bind=127.0.0.1"} <= set(objects.command())
    words = PrefectServer(tmp_path).command()
    assert words[words.index("--host") + 1] == "127.0.0.1"
    words = PostgresServer(tmp_path).command()
    assert words[words.index("listen_addresses=127.0.0.1") - 1] == "-c"


def test_a_server_of_its_own_process_says_why_it_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "PREFECT_SERVER_LOGGING_LEVEL"
    # As the command sets it for the server of its own process.
    monkeypatch.setenv(name, "CRITICAL")
    assert PrefectServer(tmp_path).environment()[name] == "WARNING"
    monkeypatch.setenv(name, "DEBUG")
    assert name not in PrefectServer(tmp_path).environment()


@pytest.mark.parametrize("url", [None, "postgresql+asyncpg://u:secret@127.0.0.1/p"])
def test_a_server_has_its_own_database_and_not_one_that_the_user_names(
    url: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in DATABASE_VARIABLES:
        monkeypatch.setenv(name, "postgresql+asyncpg://other@127.0.0.1/production")
    # As the process gets them.
    found = {**os.environ, **PrefectServer(tmp_path, url).environment()}
    expected = url or f"sqlite+aiosqlite:///file%3A{tmp_path}/home/prefect.db?uri=true"
    assert [found[name] for name in DATABASE_VARIABLES] == [expected] * 2


def test_a_killed_server_remembers_who_has_slots(tmp_path: Path) -> None:
    name = "PREFECT_SERVER_CONCURRENCY_LEASE_STORAGE"
    module = PrefectServer(tmp_path).environment()[name]
    storage = importlib.import_module(module).ConcurrencyLeaseStorage(tmp_path / "leases")
    lease = asyncio.run(storage.create_lease([uuid4()], timedelta(minutes=1)))
    again = importlib.import_module(module).ConcurrencyLeaseStorage(tmp_path / "leases")
    assert asyncio.run(again.read_lease(lease.id)) == lease
    server = yaml.safe_load((small_run.ROOT / "docker-compose.yml").read_text())["services"]["server"]
    assert server["environment"][name] == module
    # Files outside of a volume would be lost with the container.
    assert f"server:{server['environment']['PREFECT_HOME']}" in server["volumes"]


def test_every_server_writes_events_in_batches(tmp_path: Path) -> None:
    environment = PrefectServer(tmp_path).environment()
    server = yaml.safe_load((small_run.ROOT / "docker-compose.yml").read_text())["services"]["server"]["environment"]
    assert EVENT_SETTINGS.items() <= environment.items()
    assert EVENT_SETTINGS.items() <= server.items()
    # Names that Prefect does not know would change nothing.
    services = ServerServicesSettings().model_dump()
    for name in EVENT_SETTINGS:
        group = "task_run_recorder" if "TASK_RUN_RECORDER" in name else "event_persister"
        assert name.removeprefix(f"PREFECT_SERVER_SERVICES_{group.upper()}_").lower() in services[group]


def test_a_reused_process_id_is_not_taken_for_the_service(tmp_path: Path) -> None:
    ticks = read_start_ticks(os.getpid())
    assert ticks is not None
    assert _record(os.getpid(), ticks).alive
    assert not _record(os.getpid(), ticks - 1).alive
    write_records(tmp_path, {"server": _record(os.getpid(), ticks - 1)})
    assert [row["state"] for row in describe_services(tmp_path)] == ["dead"]
    # This process would have ended otherwise.
    assert stop_stack(tmp_path) == []
    assert read_records(tmp_path) == {}


def test_a_damaged_record_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "services.json").write_text('{"server": {"pid": 1}}')
    with pytest.raises(ConfigError, match="not a record of services"):
        read_records(tmp_path)


def test_without_postgres_the_error_names_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(postgres_module.shutil, "which", lambda name: None)
    monkeypatch.setattr(postgres_module.Path, "glob", lambda self, pattern: iter(()))
    with pytest.raises(ConfigError, match="package postgresql, or use --database sqlite"):
        PostgresServer(tmp_path).start()


def test_the_newest_postgres_is_taken_whatever_its_folder_is_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [tmp_path / name / "bin" for name in ("9.6", "17", "9.10", "beta", "15")]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "initdb").touch()
    monkeypatch.setattr(postgres_module.shutil, "which", lambda name: None)
    monkeypatch.setattr(postgres_module.Path, "glob", lambda self, pattern: iter(folders))
    found = []
    while folders:
        found.append(Path(postgres_module.find_postgres_program("initdb")).parent)
        folders.remove(found[-1])
    assert [folder.parent.name for folder in found] == ["17", "15", "9.10", "9.6", "beta"]


def test_an_interrupted_first_start_leaves_no_half_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    interrupted = [True]

    def initdb(words: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        folder = Path(words[words.index("-D") + 1])
        assert not list(folder.iterdir())
        (folder / "PG_VERSION").write_text("17")
        if interrupted.pop():
            raise KeyboardInterrupt
        (folder / "global").mkdir()
        return subprocess.CompletedProcess(words, 0, "", "")

    monkeypatch.setattr(postgres_module.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(postgres_module, "find_postgres_program", lambda name: name)
    monkeypatch.setattr(postgres_module.subprocess, "run", initdb)
    server = PostgresServer(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        server.prepare()
    assert not server.data.exists()
    interrupted.append(False)
    server.prepare()
    assert (server.data / "global").is_dir()
    # A whole one is taken as it is.
    server.prepare()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "password", "port", "socket"]


def test_a_folder_in_the_databases_place_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = subprocess.CompletedProcess([], 0, "", "")
    monkeypatch.setattr(postgres_module.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(postgres_module, "find_postgres_program", lambda name: name)
    monkeypatch.setattr(postgres_module.subprocess, "run", lambda words, **options: done)
    server = PostgresServer(tmp_path)
    server.data.mkdir()
    (server.data / "notes.txt").write_text("mine")
    with pytest.raises(ResourceError, match=r"cannot take its place.*Remove this folder"):
        server.prepare()
    assert (server.data / "notes.txt").read_text() == "mine"


def test_clients_find_the_server_where_a_worker_does_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def ensure(stack: Stack, service: Service) -> None:
        if isinstance(service, Worker):
            raise ResourceError("the worker did not become healthy", remedy="See its log.")
        service.folder.mkdir(parents=True)

    monkeypatch.setattr(Stack, "_ensure", ensure)
    monkeypatch.setattr(stack_module, "deploy_flows", lambda *words, **named: None)
    with pytest.raises(ResourceError, match="worker"):
        Stack(tmp_path, store_server=False, database="sqlite").start()
    written = (tmp_path / "env").read_text()
    assert "export PREFECT_API_URL=" in written and "export GENRE_STORE=" in written


def test_variables_for_clients_are_one_object_with_json(tmp_path: Path) -> None:
    (tmp_path / "env").write_text("export PREFECT_API_URL=http://127.0.0.1:4200/api\nexport GENRE_STORE='/a b=c'\n")
    words = ["ops", "status", "--folder", str(tmp_path), "--env"]
    found = json.loads(CliRunner().invoke(app, [*words, "--json"], catch_exceptions=False).stdout)
    assert found["environment"] == {"PREFECT_API_URL": "http://127.0.0.1:4200/api", "GENRE_STORE": "/a b=c"}
    assert (found["status"], found["exit_code"]) == ("done", 0)
    assert CliRunner().invoke(app, words).stdout == (tmp_path / "env").read_text()


def test_trainings_are_deployed_into_a_folder_that_workers_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders: list[Path] = []

    def deploy(url: str, auth_string: None, pool: str, store: str, training_folder: Path) -> list[str]:
        folders.append(training_folder)
        return []

    monkeypatch.setattr(deployments_module, "deploy_flows", deploy)
    monkeypatch.setattr(connection, "read_api_url", lambda: "http://127.0.0.1:4200/api")
    monkeypatch.setattr(connection, "check_server", lambda url: None)
    monkeypatch.chdir(tmp_path)
    for words in ([], ["--training-folder", "/data/training"]):
        CliRunner().invoke(app, ["ops", "deploy", *words], catch_exceptions=False)
    assert folders == [tmp_path / "training", Path("/data/training")]
    filled = {d.name: fill_parameters(d, "/store", folders[1]) for d in DEPLOYMENTS}
    assert filled["log"]["store"] == filled["dataset"]["store"] == "/store"
    assert filled["training"]["folder"] == filled["training-scenes"]["folder"] == "/data/training"


def test_an_unknown_database_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown database oracle"):
        Stack(tmp_path, database="oracle").start()


def test_running_services_keep_their_options(tmp_path: Path) -> None:
    ticks = read_start_ticks(os.getpid())
    assert ticks is not None
    options = {"pool": "--pool a", "store": "--store-server", "database": "--database sqlite"}
    keep_options(tmp_path, options)
    write_records(tmp_path, {"worker-0": _record(os.getpid(), ticks)})
    keep_options(tmp_path, options)
    expected = r"with --database sqlite, and not with --database postgres.*genre ops down"
    with pytest.raises(ConfigError, match=expected):
        Stack(tmp_path, pool="a").start()
    # Nobody depends yet on a database whose server did not start.
    write_records(tmp_path, {"store-server": _record(os.getpid(), ticks)})
    keep_options(tmp_path, options | {"database": "--database postgres"})
    keep_options(tmp_path, options)
    # Those of services that have ended bind nobody.
    write_records(tmp_path, {"worker-0": _record(os.getpid(), ticks - 1)})
    keep_options(tmp_path, options | {"pool": "--pool b"})
    stop_stack(tmp_path)
    assert not (tmp_path / "options.json").exists()


def test_deployments_are_those_of_prefect_yaml() -> None:
    listed = yaml.safe_load((small_run.ROOT / "prefect.yaml").read_text())["deployments"]
    named = {(d["name"], d["entrypoint"], d["work_pool"].get("work_queue_name", RUN_QUEUE)) for d in listed}
    assert named == {(d.name, d.entrypoint, d.queue) for d in DEPLOYMENTS}


def test_the_slurm_script_starts_a_worker_per_task(tmp_path: Path) -> None:
    script = small_run.ROOT / "docs/examples/slurm/workers.sbatch"
    subprocess.run(["bash", "-n", str(script)], check=True)
    for name, line in (("srun", 'while [ "${1#--}" != "$1" ]; do shift; done; exec "$@"'), ("prefect", 'echo "$@"')):
        program = tmp_path / name
        program.write_text(f"#!/bin/bash\n{line}\n")
        program.chmod(0o755)
    env = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "PREFECT_API_URL": "http://127.0.0.1:1/api"}
    env |= {"SLURM_JOB_ID": "7", "SLURM_PROCID": "0", "PREFECT_API_AUTH_STRING": "genre:x"}
    done = subprocess.run(["bash", str(script)], env=env, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "worker start --pool genre --work-queue default --limit 1 --name slurm-7-0"


@pytest.fixture
def state() -> Iterator[Path]:
    # Not `tmp_path`, whose parents PostgreSQL's user may not enter.
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o711)
        yield folder
        stop_stack(folder)


@pytest.mark.slow
def test_two_object_servers_run_on_one_machine(tmp_path: Path) -> None:
    with ObjectServer(tmp_path / "one") as one, ObjectServer(tmp_path / "two") as two:
        assert one.is_healthy() and two.is_healthy()


@pytest.mark.slow
def test_up_twice_then_a_dataset_then_down(state: Path) -> None:
    def genre(*words: str) -> str:
        command = [sys.executable, "-m", "flows.cli.main", "ops", *words, "--folder", str(state)]
        done = subprocess.run(command, env=small_run.environment(state), capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def services() -> dict[str, Any]:
        return {row["service"]: row for row in json.loads(genre("status", "--json"))["services"]}

    genre("up", "--workers", "1")
    first = services()
    assert set(first) == {"store-server", "postgres", "server", "coordinator", "worker-0"}
    genre("up", "--workers", "1")
    assert services() == first

    env = dict(line.removeprefix("export ").split("=", 1) for line in genre("status", "--env").splitlines())
    clients = small_run.environment(state, **{name: value.strip("'") for name, value in env.items()})
    values = {"logs": [small_run.LOG], "settings": list(small_run.SETTINGS), "store": str(state / "store")}
    command = [sys.executable, "-m", "prefect", "deployment", "run", "reconstruct-dataset/dataset", "--watch"]
    command += ["--params", json.dumps(values)]
    done = subprocess.run(command, env=clients, capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 0, done.stdout + done.stderr

    genre("down")
    assert not any(read_start_ticks(row["pid"]) for row in first.values())
    assert find_free_port()
