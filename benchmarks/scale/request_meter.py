"""Counts and times the requests that a process sends to Prefect's server and to the object store."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import httpx

from storage.manifest import MANIFEST
from storage.objects.bucket import Bucket

_ID = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}")
_BUCKET_CALLS = ("read", "write", "create", "replace", "upload", "download", "delete")
_ERROR = 500


class Request(NamedTuple):
    """A request that was answered.

    Attributes:
        time_s: when the answer came, by the system's monotonic clock, which all processes of a machine share.
        group: what was asked for, without ids.
        seconds: until the answer.
        sent_bytes: in the request's body.
        is_error: whether the server failed.
    """

    time_s: float
    group: str
    seconds: float
    sent_bytes: int = 0
    is_error: bool = False


@dataclass
class RequestMeter:
    """What a process has asked for.

    Attributes:
        api: requests to Prefect's server over HTTP.
        store: requests to the object store.
        commits: names of manifests that this process has put where there was none.
        refused: names of manifests that another process had put before.
    """

    api: list[Request] = field(default_factory=list)
    store: list[Request] = field(default_factory=list)
    commits: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    def install(self) -> None:
        """Makes all clients of this process report here, for as long as the process lives."""
        _install_api(self.api)
        lock = threading.Lock()
        for name in _BUCKET_CALLS:
            setattr(Bucket, name, self._timed(name, getattr(Bucket, name), lock))
        # The method's type names the class `list`, which is a method there.
        Bucket.list = self._timed_list(Bucket.list, lock)  # type: ignore[method-assign]

    def _timed(self, group: str, call: Callable[..., Any], lock: threading.Lock) -> Callable[..., Any]:
        def timed(bucket: Bucket, name: Any, *args: Any, **kwargs: Any) -> Any:
            start_s = time.monotonic()
            answer = call(bucket, name, *args, **kwargs)
            now_s = time.monotonic()
            with lock:
                self.store.append(Request(now_s, group, now_s - start_s, _count_bytes(args)))
                if group == "create" and str(name).endswith(f"/{MANIFEST}"):
                    (self.refused if answer is None else self.commits).append(str(name))
            return answer

        return timed

    def _timed_list(self, call: Callable[..., Iterator[Any]], lock: threading.Lock) -> Callable[..., Iterator[Any]]:
        def timed(bucket: Bucket, *args: Any, **kwargs: Any) -> Iterator[Any]:
            start_s = time.monotonic()
            yield from call(bucket, *args, **kwargs)
            now_s = time.monotonic()
            with lock:
                self.store.append(Request(now_s, "list", now_s - start_s))

        return timed


@contextmanager
def metered_clients(meter: RequestMeter) -> Iterator[None]:
    """Lets the clients of this process report to a meter while a block runs.

    Args:
        meter: of the requests.

    Yields:
        Nothing.
    """
    methods: list[tuple[type[Any], str]] = [(httpx.AsyncClient, "send"), (httpx.Client, "send")]
    methods += [(Bucket, name) for name in (*_BUCKET_CALLS, "list")]
    before = [(owner, name, getattr(owner, name)) for owner, name in methods]
    meter.install()
    try:
        yield
    finally:
        for owner, name, method in before:
            setattr(owner, name, method)


def name_route(method: str, path: str) -> str:
    """Names what a request asks for.

    Args:
        method: of HTTP.
        path: of the request's URL.

    Returns:
        Method and path without ids.

    >>> name_route("GET", "/api/flow_runs/2f0c1d53-6a0c-4f0e-8d5b-3f5b1f3f5f10")
    'GET flow_runs/ID'
    """
    return f"{method} {_ID.sub('ID', path.removeprefix('/api/')).strip('/')}"


def _install_api(requests: list[Request]) -> None:
    # Below Prefect's clients: what they try again, and their tokens against forged requests, count too.
    send_async = httpx.AsyncClient.send
    send_sync = httpx.Client.send

    def note(request: Any, start_s: float, response: Any) -> None:
        now_s = time.monotonic()
        group = name_route(request.method, request.url.path)
        size = int(request.headers.get("content-length", 0))
        requests.append(Request(now_s, group, now_s - start_s, size, response.status_code >= _ERROR))

    async def timed_async(client: Any, request: Any, *args: Any, **kwargs: Any) -> Any:
        start_s = time.monotonic()
        response = await send_async(client, request, *args, **kwargs)
        note(request, start_s, response)
        return response

    def timed_sync(client: Any, request: Any, *args: Any, **kwargs: Any) -> Any:
        start_s = time.monotonic()
        response = send_sync(client, request, *args, **kwargs)
        note(request, start_s, response)
        return response

    httpx.AsyncClient.send = timed_async  # type: ignore[method-assign, assignment]
    httpx.Client.send = timed_sync  # type: ignore[method-assign, assignment]


def _count_bytes(args: tuple[Any, ...]) -> int:
    if not args:
        return 0
    if isinstance(args[0], bytes):
        return len(args[0])
    # An upload names a file.
    return int(args[0].stat().st_size) if hasattr(args[0], "stat") else 0
