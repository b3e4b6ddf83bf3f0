"""Connects a command to Prefect: to the user's own server where one is set, else to a server in this process."""

from __future__ import annotations

import io
import os
import secrets
import ssl
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, suppress
from datetime import UTC, datetime
from http.client import HTTPException
from pathlib import Path
from typing import TYPE_CHECKING

from flows.prefect_api.network_variables import find_unusable_files, is_network_variable
from flows.prefect_api.server_thread import DATABASE_VARIABLES, ServerThread, database_url, find_stated_database
from flows.prefect_api.settings_sources import API_URL, check_settings_files, find_prefect_home, find_source
from genre_tasks.errors import ConfigError

if TYPE_CHECKING:
    from prefect.client.orchestration import SyncPrefectClient

_ANSWER_TIMEOUT_S = 10.0
_SEND_TIMEOUT_S = 3.0
_RECORD_TIMEOUT_S = 10.0
_RECORD_STEP_S = 0.05
_WITHOUT_PERMISSION = (401, 403)
_CERTIFICATES = "PREFECT_API_SSL_CERT_FILE"


@contextmanager
def connect_to_prefect() -> Iterator[None]:
    """Makes flows inside the block report to an API that answers.

    Yields:
        Nothing; Prefect's settings are changed while the block runs.

    Raises:
        ConfigError: Prefect's settings cannot be read, or the server that they name does not answer.
        ResourceError: the server in this process cannot start.

    Example::

        with connect_to_prefect():
            reconstruct_log("pandaset:data/002")
    """
    url = read_api_url()
    if url is not None:
        check_server(url)
        yield
        return
    home = _make_home()
    server = ServerThread(home)
    changes = dict.fromkeys(name for name in os.environ if is_network_variable(name))
    with _changed_environment({**changes, **_server_settings(server.url, home)}):
        server.start()
        started_at = datetime.now(UTC)
        try:
            yield
        finally:
            _send_remaining_events()
            _wait_for_records(started_at)
            server.stop()


def read_api_url() -> str | None:
    """Reads the address of the user's own Prefect server from Prefect's settings.

    Returns:
        The address, or ``None`` if there is none.

    Raises:
        ConfigError: the settings cannot be read.
    """
    check_settings_files()
    # Whatever Prefect raises here is about its settings, which the user can change.
    try:
        # Prefect makes an HTTP client when it is imported, also where none is needed.
        with _changed_environment(dict.fromkeys(find_unusable_files())), redirect_stderr(io.StringIO()) as printed:
            from prefect.settings import get_current_settings

            url = get_current_settings().api.url
    except Exception as error:
        first_line = " ".join(str(error).split())[:300]
        remedy = "Correct or unset the variable PREFECT_… that it names, in the environment, a file or a profile."
        raise ConfigError(f"Prefect does not accept its settings: {first_line}", remedy=remedy) from error
    # What Prefect prints while it is imported is for the user, unless the error above says the same.
    sys.stderr.write(printed.getvalue())
    return url


def check_server(url: str) -> None:
    """Asks the user's own Prefect server for its health, and whether it serves this client.

    Args:
        url: address of its API.

    Raises:
        ConfigError: it does not answer, or wants another password; says where the address comes from and how to
            unset it.
    """
    _check_server_answers(url)
    _check_client_is_accepted(url)


def _check_server_answers(url: str) -> None:
    for variable, reason in find_unusable_files().items():
        remedy = f"Correct or unset {variable}."
        raise ConfigError(f"{variable}={os.environ[variable]} cannot be used ({reason})", remedy=remedy)
    context = _make_tls_context()
    try:
        with urllib.request.urlopen(f"{url.rstrip('/')}/health", timeout=_ANSWER_TIMEOUT_S, context=context):
            return
    except urllib.error.HTTPError as error:
        # A server that wants a password answers too; whether it takes ours, Prefect's client finds out.
        if error.code in _WITHOUT_PERMISSION:
            return
        raise _no_server(url, f"HTTP status {error.code}") from error
    except (OSError, ValueError, HTTPException) as error:
        raise _no_server(url, getattr(error, "reason", error)) from error


def _make_tls_context() -> ssl.SSLContext:
    """The certificates that Prefect's client trusts, by its settings: a server that it can use must count as one."""
    import certifi
    from prefect.settings import get_current_settings

    api = get_current_settings().api
    if api.tls_insecure_skip_verify:
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        return context
    try:
        return ssl.create_default_context(cafile=api.ssl_cert_file or certifi.where())
    except OSError as error:
        problem = f"{_CERTIFICATES}={api.ssl_cert_file} cannot be used ({error.strerror or error})"
        remedy = f"Name a file of certificates. {find_source(_CERTIFICATES) or ''}".strip()
        raise ConfigError(problem, remedy=remedy) from error


def _no_server(url: str, reason: object) -> ConfigError:
    remedy = f"Start it, or go on without it. {find_source(API_URL) or ''}".strip()
    return ConfigError(f"no Prefect server answers at {API_URL}={url} ({reason})", remedy=remedy)


def _check_client_is_accepted(url: str) -> None:
    """Asks the user's own server for its version, as every flow does at its start: with the password, if any."""
    from prefect.client.orchestration import get_client

    # Whatever Prefect's client raises here ends every flow.
    try:
        with get_client(sync_client=True) as client:
            client.raise_for_api_version_mismatch()
    except Exception as error:
        first_line = next(iter(str(error).splitlines()), type(error).__name__)
        remedy = f"Set PREFECT_API_AUTH_STRING or PREFECT_API_KEY if it wants one. {find_source(API_URL) or ''}".strip()
        raise ConfigError(
            f"{API_URL}={url} does not serve this client of Prefect: {first_line}", remedy=remedy
        ) from error


def _make_home() -> Path:
    """Makes the folder of the database, and tries to write there."""
    home = find_prefect_home().absolute()
    try:
        home.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=home):
            pass
    except OSError as error:
        problem = f"PREFECT_HOME is no folder that can be written ({error.strerror})"
        remedy = "Unset PREFECT_HOME, or name a folder in which this user may write, and with space left."
        raise ConfigError(problem, remedy=remedy, file=home) from error
    return home


def _server_settings(url: str, home: Path) -> dict[str, str]:
    import certifi

    password = secrets.token_hex()
    settings = {
        API_URL: url,
        # What the user has set for a server of the user's own would keep this process's client out. The password
        # also keeps other users of this machine out.
        "PREFECT_SERVER_API_BASE_PATH": "/api",
        "PREFECT_SERVER_API_AUTH_STRING": password,
        "PREFECT_API_AUTH_STRING": password,
        # Certificates are read for every client, and those of SSL_CERT_FILE were noted when Prefect was imported.
        _CERTIFICATES: certifi.where(),
        # Prefect must never start a second server: it would stay behind.
        "PREFECT_SERVER_ALLOW_EPHEMERAL_MODE": "false",
        # Nothing is configured by blocks here, and they take a second of the start.
        "PREFECT_API_BLOCKS_REGISTER_ON_START": "false",
    }
    if find_stated_database() is None:
        settings[DATABASE_VARIABLES[0]] = database_url(home)
    return settings


@contextmanager
def _changed_environment(changes: Mapping[str, str | None]) -> Iterator[None]:
    """Sets variables (``None`` removes one) for Prefect's settings, and puts them back."""
    before = {name: os.environ.get(name) for name in changes}
    _set_environment(changes)
    try:
        yield
    finally:
        _set_environment(before)


def _set_environment(variables: Mapping[str, str | None]) -> None:
    # Prefect is not imported before it needs to be: with its import it reads the environment.
    if not variables:
        return
    for name, value in variables.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
    from prefect.context import refresh_global_settings_context

    # Prefect read the environment when it was imported; threads of its own read the settings from here.
    refresh_global_settings_context()


def _send_remaining_events() -> None:
    """Waits until the states of all tasks have reached the server, which Prefect sends in the background."""
    from prefect.events.worker import EventsWorker

    EventsWorker.drain_all(timeout=_SEND_TIMEOUT_S, at_exit=True)


def _wait_for_records(started_at: datetime) -> None:
    """Waits until the server of this process has recorded what it received: its end loses the rest.

    Tasks of flows that were interrupted stay unfinished for good, and are not waited for.
    """
    from prefect.client.orchestration import get_client

    end_s = time.monotonic() + _RECORD_TIMEOUT_S
    # Records serve people who look back. Whatever fails here must not fail their run.
    with suppress(Exception), get_client(sync_client=True) as client:
        # Twice in a row, since an event may be on its way from the socket to the queue.
        complete = 0
        while complete < 2 and time.monotonic() < end_s:
            complete = 0 if _count_queued_events() or _has_unfinished_tasks(client, started_at) else complete + 1
            time.sleep(_RECORD_STEP_S)


def _count_queued_events() -> int:
    """Events that the server of this process has received, and not begun to record."""
    from prefect.server.utilities.messaging.memory import Topic

    subscriptions = list(Topic.by_name("events")._subscriptions)
    return sum(subscription._queue.qsize() + subscription._retry.qsize() for subscription in subscriptions)


def _has_unfinished_tasks(client: SyncPrefectClient, started_at: datetime) -> bool:
    """Tells whether a flow is recorded as ended, and a task of it is not."""
    from prefect.client.schemas.filters import FlowRunFilter, TaskRunFilter

    flows = {"state": {"type": {"any_": ["COMPLETED", "FAILED"]}}, "start_time": {"after_": started_at}}
    tasks = {"state": {"type": {"any_": ["SCHEDULED", "PENDING", "RUNNING"]}}}
    unfinished = client.read_task_runs(
        flow_run_filter=FlowRunFilter.model_validate(flows),
        task_run_filter=TaskRunFilter.model_validate(tasks),
        limit=1,
    )
    return bool(unfinished)
