"""Connecting to Prefect on machines as people have them: proxies, odd folders, servers that are not there."""

from __future__ import annotations

import errno
import os
import sqlite3
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from prefect.settings import PREFECT_API_URL, PREFECT_SERVER_LOGGING_LEVEL, temporary_settings

from flows.cli.main import prepare_environment
from flows.machine.state_folder import find_state_folder
from flows.prefect_api.connection import check_server, connect_to_prefect
from flows.prefect_api.network_variables import find_unusable_files
from flows.prefect_api.server_thread import ServerThread, _alone_in
from flows.prefect_api.settings_sources import check_settings_files, find_prefect_home, find_source
from genre_tasks.errors import ConfigError, InputError

ROOT = Path(__file__).resolve().parents[2]
NOBODY = "http://127.0.0.1:9/api"
FLOW = textwrap.dedent(
    """
    import os, pathlib, sqlite3, psutil
    from flows.prefect_api.connection import connect_to_prefect
    with connect_to_prefect():
        from prefect import flow, task
        children = len(psutil.Process().children())
        @task
        def twice(x): return 2 * x
        @flow
        def add(): return sum(twice(k) for k in range(5))
        print(add(), children, os.environ.get("HTTP_PROXY"))
    database = sqlite3.connect(pathlib.Path(os.environ["PREFECT_HOME"]) / "prefect.db")
    for table in ("flow_run", "task_run"):
        print(table, database.execute(f"select state_name, count(*) from {table} group by state_name").fetchall())
    print(os.environ.get("HTTP_PROXY"), os.environ.get("PREFECT_API_URL"))
    """
)


def run_flow(
    folder: Path, script: str = FLOW, working_folder: Path | None = None, **variables: str
) -> subprocess.CompletedProcess[str]:
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    settings = {"PREFECT_HOME": str(folder / "prefect"), "PYTHONPATH": str(ROOT)}
    settings |= {"PREFECT_LOGGING_LEVEL": "CRITICAL", "PREFECT_SERVER_LOGGING_LEVEL": "CRITICAL"}
    settings |= {"DO_NOT_TRACK": "1", "PREFECT_SERVER_ANALYTICS_ENABLED": "false"}
    return subprocess.run(
        [sys.executable, "-c", script],
        env=inherited | settings | variables,
        cwd=working_folder or folder,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_a_flow_keeps_its_records_behind_a_proxy_and_in_a_folder_of_any_name(tmp_path: Path) -> None:
    """A company's machine, and a folder that looks like part of a URL.

    Reports: axios/axios#3355 (127.0.0.1 through a proxy), sqlalchemy/alembic#700 (a % in a database's address).
    """
    folder = tmp_path / "50%2F off? #1 – é"
    folder.mkdir()
    proxies = dict.fromkeys(("HTTP_PROXY", "http_proxy", "https_proxy"), "http://10.255.255.1:3128")
    # A company's server may want a password and serve below another path.
    server = {"PREFECT_SERVER_API_AUTH_STRING": "a:b", "PREFECT_API_KEY": "x", "PREFECT_SERVER_API_BASE_PATH": "/p"}
    files = {"SSL_CERT_FILE": "/nowhere/ca.pem", "SSLKEYLOGFILE": "/nowhere/keys"}
    done = run_flow(folder, ALL_PROXY="socks5://10.255.255.1:1080", NO_PROXY="[::1,,*.x", **server, **files, **proxies)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    # One process, the records are complete, and the environment is put back.
    assert done.stdout.splitlines() == [
        "20 0 None",
        "flow_run [('Completed', 1)]",
        "task_run [('Completed', 5)]",
        "http://10.255.255.1:3128 None",
    ]
    assert {path.name for path in folder.iterdir()} == {"prefect"}


def test_the_command_silences_prefect_and_its_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    variables = {"XDG_STATE_HOME": str(tmp_path), "PREFECT_LOGGING_LEVEL": "ERROR"}
    monkeypatch.setattr(os, "environ", variables)
    prepare_environment(debug=False)
    # The server logs by a level of its own, even what it tries again with success.
    assert variables[PREFECT_SERVER_LOGGING_LEVEL.name] == "CRITICAL"
    assert variables["PREFECT_LOGGING_LEVEL"] == "ERROR"


def test_two_at_once_share_a_new_database_in_a_working_folder_that_is_read_only(tmp_path: Path) -> None:
    """Two first starts of a machine, where nobody may write.

    Reports: PrefectHQ/prefect#19771 (locked database), Mibayy/token-savior#70 (two first starts at once),
    DCAN-Labs/BIBSnet#43 (a folder that is read-only).
    """
    # Nobody can make a file in /proc, not even the superuser.
    with ThreadPoolExecutor(2) as pool:
        commands = [pool.submit(run_flow, tmp_path, working_folder=Path("/proc")) for _ in range(2)]
        finished = [command.result() for command in commands]
    for done in finished:
        assert done.returncode == 0, done.stderr
        assert done.stdout.splitlines()[0].startswith("20 0 ")
    assert {path.name for path in tmp_path.iterdir()} == {"prefect"}
    # Both have waited for the records of their tasks.
    with closing(sqlite3.connect(tmp_path / "prefect" / "prefect.db")) as database:
        states = database.execute("select state_name, count(*) from task_run group by state_name").fetchall()
    assert states == [("Completed", 10)]


def damage(database: Path) -> None:
    database.write_bytes(b"no database" * 1000)


def make_newer(database: Path) -> None:
    with sqlite3.connect(database) as connection:
        connection.execute("create table alembic_version (version_num varchar(32) not null)")
        connection.execute("insert into alembic_version values ('abcdef')")


@pytest.mark.parametrize(("change", "reason"), [(damage, "file is not a database"), (make_newer, "'abcdef'")])
def test_a_database_that_cannot_be_used_is_named_at_once(
    change: Callable[[Path], None], reason: str, tmp_path: Path
) -> None:
    """Report: PrefectHQ/prefect#5118 (a server that does not start, and a page of traceback)."""
    database = tmp_path / "prefect" / "prefect.db"
    database.parent.mkdir()
    change(database)
    done = run_flow(tmp_path)
    last = done.stderr.splitlines()[-1]
    assert last.startswith("genre_tasks.errors.ResourceError: Prefect's local API cannot start")
    assert reason in last and str(database) in last and "Delete that file" in last


def test_a_server_that_is_not_there_is_named_with_its_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Report: PrefectHQ/prefect#5837 (a traceback of a refused connection, and nothing says which address)."""
    monkeypatch.setenv("PREFECT_API_URL", NOBODY)
    with pytest.raises(ConfigError) as caught:
        check_server(NOBODY)
    assert NOBODY in str(caught.value) and "unset PREFECT_API_URL" in str(caught.value)
    monkeypatch.delenv("PREFECT_API_URL")
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path))
    assert find_source("PREFECT_API_URL") is None
    profile = f'active = "own"\n[profiles.own]\nPREFECT_API_URL = "{NOBODY}"\n'
    (tmp_path / "profiles.toml").write_text(profile)
    assert str(tmp_path / "profiles.toml") in str(find_source("PREFECT_API_URL"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pyproject.toml").write_text('[tool.prefect.api]\nurl = "http://x"\n')
    assert str(tmp_path / "pyproject.toml") in str(find_source("PREFECT_API_URL"))
    (tmp_path / "prefect.toml").write_text('[api]\nurl = "http://x"\n')
    assert str(tmp_path / "prefect.toml") in str(find_source("PREFECT_API_URL"))
    for line in ("PREFECT_API_URL=http://x\n", "A=1\n export  prefect_api_url = http://x\n"):
        (tmp_path / ".env").write_text(line)
        assert str(tmp_path / ".env") in str(find_source("PREFECT_API_URL"))
    (tmp_path / ".env").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read"):
        find_source("PREFECT_API_URL")


@pytest.mark.parametrize("name", ["pyproject.toml", "prefect.toml"])
@pytest.mark.parametrize("content", [b"[tool\n", b"\xff\xfe\x00a", b"a = 1\na = 2\n"])
def test_a_broken_file_of_settings_is_one_error(
    name: str, content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Report: PrefectHQ/prefect#18295 (a pyproject.toml that its reader does not take)."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        check_settings_files()
    assert caught.value.file == str(tmp_path / name)


def test_a_setting_that_prefect_refuses_is_one_line(tmp_path: Path) -> None:
    script = FLOW.replace("with connect", "import flows.prefect_api.connection as c\nwith c.connect", 1)
    done = run_flow(tmp_path, script, PREFECT_SERVER_API_PORT="many")
    assert "genre_tasks.errors.ConfigError: Prefect does not accept its settings" in done.stderr
    assert "Failed to initialize plugins" not in done.stderr


def test_the_state_folder_is_one_that_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports: DCAN-Labs/BIBSnet#43 (a home that is read-only), PrefectHQ/prefect#11121 (a shared temporary folder)."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert find_state_folder() == tmp_path / "state" / "genre"
    # A home that is a file: nothing can be made below it, whoever asks.
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert find_state_folder() == tmp_path / f"genre-{os.getuid()}"
    assert find_state_folder().stat().st_mode & 0o077 == 0


def test_nothing_is_started_beside_a_server_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flows.prefect_api.connection.read_api_url", lambda: NOBODY)
    with pytest.raises(ConfigError, match="no Prefect server answers"), connect_to_prefect():
        raise AssertionError("the block must not run")


@pytest.mark.parametrize("status", [404, 500, 503])
def test_a_server_of_something_else_is_no_prefect_server(status: int) -> None:
    """Report: none found; case 11 of the list of odd logs (an address at which another program answers)."""
    refused = pytest.raises(ConfigError, match=f"no Prefect server answers at .* .HTTP status {status}")
    with _server_that_answers(status) as url, refused:
        check_server(url)


def test_a_server_that_wants_another_password_is_a_mistake_of_the_user() -> None:
    refused = pytest.raises(ConfigError, match=r"does not serve this client.*PREFECT_API_AUTH_STRING")
    with _server_that_answers(401) as url, temporary_settings({PREFECT_API_URL: url}), refused:
        check_server(url)


@contextmanager
def _server_that_answers(status: int) -> Iterator[str]:
    class Other(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            self.end_headers()

        def log_message(self, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Other) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/api"
        finally:
            server.shutdown()


@pytest.mark.parametrize("url", ["http://a b/api", "garbage", "http://127.0.0.1:99999/api", "http://127.0.0.1:x/api"])
def test_an_address_that_is_none_is_one_error(url: str) -> None:
    with pytest.raises(ConfigError, match="no Prefect server answers"):
        check_server(url)


def test_a_users_server_that_refuses_this_client_is_one_error(tmp_path: Path) -> None:
    """Report: PrefectHQ/prefect#5837 (a traceback of the client, and nothing says which address)."""
    script = textwrap.dedent(
        """
        import os
        from flows.prefect_api.connection import connect_to_prefect
        with connect_to_prefect():
            # The server of the outer block is the user's own for the inner one.
            with connect_to_prefect():
                print("accepted")
            os.environ["PREFECT_API_URL"] += "/of/another/program"
            import flows.prefect_api.connection as connection
            connection._check_server_answers = lambda url: None
            connection._set_environment({"PREFECT_API_URL": os.environ["PREFECT_API_URL"]})
            with connect_to_prefect():
                print("accepted")
        """
    )
    done = run_flow(tmp_path, script)
    assert done.stdout == "accepted\n", done.stderr
    assert "ConfigError: PREFECT_API_URL=http://127.0.0.1:" in done.stderr
    assert "does not serve this client of Prefect" in done.stderr


def test_certificates_that_are_not_there_are_named_for_a_users_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ca.pem").write_text("no certificate")
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "ca.pem"))
    monkeypatch.setenv("SSLKEYLOGFILE", str(tmp_path / "missing" / "keys"))
    assert set(find_unusable_files()) == {"SSL_CERT_FILE", "SSLKEYLOGFILE"}
    with pytest.raises(ConfigError, match=r"SSL_CERT_FILE=.*ca\.pem cannot be used"):
        check_server(NOBODY)
    monkeypatch.delenv("SSL_CERT_FILE")
    monkeypatch.setenv("SSLKEYLOGFILE", str(tmp_path / "keys"))
    assert find_unusable_files() == {}


def test_a_prefect_home_is_a_folder_that_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Report: none found; case 12 of the list of odd logs (a folder for the state that is none)."""
    (tmp_path / "file").write_text("")
    for home in (tmp_path / "file", tmp_path / "file" / "below"):
        monkeypatch.setenv("PREFECT_HOME", str(home))
        with pytest.raises(ConfigError, match="PREFECT_HOME is no folder that can be written"), connect_to_prefect():
            raise AssertionError("the block must not run")
    monkeypatch.setenv("PREFECT_HOME", "~nobody-of-this-name/x")
    with pytest.raises(InputError, match="there is no home folder"):
        find_prefect_home()
    # An empty variable counts as none: the database must not land in the working folder.
    monkeypatch.setenv("PREFECT_HOME", "")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    prepare_environment(debug=False)
    assert os.environ["PREFECT_HOME"] == str(tmp_path / "state" / "genre" / "prefect")


def test_odd_profiles_name_no_setting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path))
    for text in ("active = [1]\n[profiles]\nx = 1\n", 'active = "x"\nprofiles = 3\n', "[profiles.x]\n"):
        (tmp_path / "profiles.toml").write_text(text)
        assert find_source("PREFECT_API_URL") is None


def test_a_database_of_the_users_is_named_by_its_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PREFECT_API_DATABASE_CONNECTION_URL", "garbage")
    server = ServerThread(tmp_path)
    server.stop()
    assert "unset PREFECT_API_DATABASE_CONNECTION_URL" in str(server._start_error("no"))


def test_warnings_as_errors_do_not_stop_the_server() -> None:
    """Report: none found; case 10 of the list of odd logs (PYTHONWARNINGS=error of a build machine: no answer)."""
    script = "import flows.cli.main as m, warnings\nm.prepare_environment(False)\nwarnings.warn('x')\nprint('on')"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error::UserWarning", "-c", script]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == "on\n"


@pytest.mark.parametrize(
    ("code", "remedy"),
    [
        (sqlite3.SQLITE_FULL, "Free disk space"),
        (sqlite3.SQLITE_IOERR_WRITE, "Free disk space"),
        (sqlite3.SQLITE_CORRUPT, "Delete that file"),
    ],
)
def test_a_full_disk_is_no_damaged_database(code: int, remedy: str, tmp_path: Path) -> None:
    server = ServerThread(tmp_path)
    server.stop()
    cause = sqlite3.OperationalError("disk")
    cause.sqlite_errorcode = code
    server._error = RuntimeError("start")
    server._error.__cause__ = cause
    assert remedy in str(server._start_error("disk"))


def test_too_few_open_files_are_one_error(tmp_path: Path) -> None:
    """Report: none found; case 10 of the list of odd logs (a server that can accept nobody waits forever)."""
    limit = "import resource\nresource.setrlimit(resource.RLIMIT_NOFILE, ({soft}, {hard}))\n"
    script = (
        limit + "from flows.prefect_api.server_thread import _ensure_open_files as ensure\n"
        "ensure()\nprint(resource.getrlimit(resource.RLIMIT_NOFILE)[0])\n"
    )
    assert run_flow(tmp_path, script.format(soft=40, hard=40)).stderr.splitlines()[-1].endswith("ulimit -n 1024.")
    assert run_flow(tmp_path, script.format(soft=40, hard=200)).stdout == "64\n"


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOTSUP])
def test_a_folder_without_locks_is_named(code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(file: object, operation: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("flows.prefect_api.server_thread.fcntl.flock", refuse)
    server = ServerThread(tmp_path)
    server.stop()
    with pytest.raises(OSError, match="Errno") as caught, _alone_in(tmp_path):
        raise AssertionError("the block must not run")
    server._error = caught.value
    error = server._start_error(os.strerror(code))
    assert error.remedy == "Set PREFECT_HOME or XDG_STATE_HOME to a local disk."
    assert error.file == str(tmp_path) and os.strerror(code) in str(error)
