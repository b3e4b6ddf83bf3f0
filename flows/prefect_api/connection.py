"""Connects a command to Prefect: to the user's own server where one is set, else to a server in this process."""

from __future__ import annotations

import os
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from flows.prefect_api.server_thread import ServerThread, database_url
from flows.prefect_api.settings_sources import API_URL, check_settings_files, find_source
from genre_tasks.errors import ConfigError

_ANSWER_TIMEOUT_S = 10.0
_SEND_TIMEOUT_S = 3.0
# What httpx and websockets read when a client is made: a proxy of the company cannot reach this machine's loopback, and
# one that they cannot speak to, or certificates that are not there, stop them before they look at the address.
_NETWORK_VARIABLES = (
    "http_proxy",
    "https_proxy",
    "all_proxy",
    "ws_proxy",
    "wss_proxy",
    "ssl_cert_file",
    "ssl_cert_dir",
)


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
        check_server_answers(url)
        yield
        return
    home = Path(os.environ["PREFECT_HOME"]).expanduser().absolute()
    home.mkdir(parents=True, exist_ok=True)
    server = ServerThread(home)
    changes = dict.fromkeys(name for name in os.environ if name.lower() in _NETWORK_VARIABLES)
    with _changed_environment({**changes, **_server_settings(server.url, home)}):
        server.start()
        try:
            yield
        finally:
            _send_remaining_events()
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
        from prefect.settings import get_current_settings

        return get_current_settings().api.url
    except Exception as error:
        first_line = " ".join(str(error).split())[:300]
        remedy = "Correct or unset the variable PREFECT_… that it names, in the environment, a file or a profile."
        raise ConfigError(f"Prefect does not accept its settings: {first_line}", remedy=remedy) from error


def check_server_answers(url: str) -> None:
    """Asks a Prefect server for its health.

    Args:
        url: address of its API.

    Raises:
        ConfigError: it does not answer; says where the address comes from and how to unset it.
    """
    try:
        # A server that wants a password answers too: with an error that the flow will explain.
        with urllib.request.urlopen(f"{url.rstrip('/')}/health", timeout=_ANSWER_TIMEOUT_S):
            return
    except urllib.error.HTTPError:
        return
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        raise ConfigError(
            f"no Prefect server answers at {API_URL}={url} ({reason})",
            remedy=f"Start it, or go on without it. {find_source(API_URL) or ''}".strip(),
        ) from error


def _server_settings(url: str, home: Path) -> dict[str, str]:
    import certifi

    settings = {
        API_URL: url,
        # Certificates are read for every client, and those of SSL_CERT_FILE were noted when Prefect was imported.
        "PREFECT_API_SSL_CERT_FILE": certifi.where(),
        # Prefect must never start a second server: it would stay behind.
        "PREFECT_SERVER_ALLOW_EPHEMERAL_MODE": "false",
        # Nothing is configured by blocks here, and they take a second of the start.
        "PREFECT_API_BLOCKS_REGISTER_ON_START": "false",
    }
    names = ("PREFECT_API_DATABASE_CONNECTION_URL", "PREFECT_SERVER_DATABASE_CONNECTION_URL")
    if not any(name in os.environ for name in names):
        settings[names[0]] = database_url(home)
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
    from prefect.context import refresh_global_settings_context

    for name, value in variables.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
    # Prefect read the environment when it was imported; threads of its own read the settings from here.
    refresh_global_settings_context()


def _send_remaining_events() -> None:
    """Waits until the states of all tasks have reached the server, which Prefect sends in the background."""
    from prefect.events.worker import EventsWorker

    EventsWorker.drain_all(timeout=_SEND_TIMEOUT_S, at_exit=True)
