"""The client of an object store: its URI without credentials, and its settings from the environment."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterable
from datetime import timedelta
from typing import Any
from urllib.parse import urlsplit

from genre_tasks.errors import ConfigError

SCHEMES = ("s3", "gs", "az", "abfs", "abfss")
"""Schemes of URIs of stores that are no folder."""
RETRY_VARIABLE = "GENRE_STORE_RETRY_SECONDS"
"""The environment variable for how long a request is tried again while the store does not answer."""
_RETRY_S = 180.0
_REQUEST_S = 60.0
_CLOUD_VARIABLES = ("AWS_", "AZURE_", "GOOGLE_", RETRY_VARIABLE)
_ENDPOINT_VARIABLES = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")


def check_uri(uri: str) -> str:
    """Checks the URI of a store in a bucket.

    Args:
        uri: such as ``s3://bucket/prefix``.

    Returns:
        The URI without "/" at its end.

    Raises:
        ConfigError: it names no bucket, or holds credentials or parameters.

    >>> check_uri("s3://bucket/genre/")
    's3://bucket/genre'
    """
    parts = urlsplit(uri)
    # The URI may be in logs and manifests. It is not repeated in this error either.
    if parts.username is not None or parts.password is not None or parts.query or parts.fragment:
        raise ConfigError(
            "the store's URI holds credentials or parameters",
            remedy="Give scheme, bucket and path alone; credentials belong into the environment.",
        )
    path = parts.path.strip("/")
    is_sound = all(re.fullmatch(r"[\w.=+ -]+", part) and part not in (".", "..") for part in path.split("/") if path)
    if parts.scheme not in SCHEMES or not parts.netloc or not is_sound:
        known = ", ".join(f"{scheme}://bucket/path" for scheme in SCHEMES[:3])
        raise ConfigError(f"the store {uri!r} is of no known kind", remedy=f"Give a folder, or one of {known}.")
    return f"{parts.scheme}://{parts.netloc}" + (f"/{path}" if path else "")


def read_retry_seconds() -> float:
    """Reads how long a request is tried again while the store does not answer.

    Returns:
        Seconds, from the environment variable ``GENRE_STORE_RETRY_SECONDS``.

    Raises:
        ConfigError: it is no number from 0 on.
    """
    return read_seconds(RETRY_VARIABLE, _RETRY_S)


def read_seconds(variable: str, default: float) -> float:
    """Reads a number of seconds from the environment.

    Args:
        variable: the environment variable's name.
        default: where it is not set.

    Returns:
        The number.

    Raises:
        ConfigError: it is no number from 0 on.
    """
    text = os.environ.get(variable)
    try:
        value = default if not text else float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise ConfigError(f"{variable} is {text!r}", remedy="Give a number of seconds, such as 60.")
    return value


def open_client(uri: str) -> Any:
    """Opens the client of a store; one serves all threads of a process, as it keeps connections.

    Args:
        uri: as :func:`check_uri` returns it.

    Returns:
        A store of the package obstore.

    Raises:
        ConfigError: a variable of the environment is wrong or missing.
    """
    # By the environment too, as a notebook may change it.
    variables = tuple(sorted((k, v) for k, v in os.environ.items() if k.startswith(_CLOUD_VARIABLES)))
    return _open_client(uri, variables)


@functools.lru_cache(maxsize=16)
def _open_client(uri: str, environment: Iterable[tuple[str, str]]) -> Any:
    from obstore.store import from_url

    variables = dict(environment)
    endpoint = next((variables[name] for name in _ENDPOINT_VARIABLES if variables.get(name)), "")
    options: dict[str, Any] = {"timeout": timedelta(seconds=_REQUEST_S), "connect_timeout": timedelta(seconds=5)}
    # An endpoint that somebody wrote as http:// is meant so.
    if endpoint.startswith("http://") or variables.get("AWS_ALLOW_HTTP", "").lower() == "true":
        options["allow_http"] = True
    retry = {
        # Short hiccups pass unseen. What takes longer is logged, and tried again by the class above.
        "max_retries": 3,
        "retry_timeout": timedelta(seconds=min(10.0, read_retry_seconds())),
        "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=1), "base": 2},
    }
    try:
        return from_url(uri, client_options=options, retry_config=retry)  # type: ignore[call-overload]
    except Exception as error:
        raise ConfigError(
            f"the store {uri} cannot be opened: {str(error).partition(chr(10))[0][:200]}",
            remedy="Check the environment's variables for the cloud, such as AWS_REGION or AZURE_STORAGE_ACCOUNT_NAME.",
        ) from error
