"""Counters of a service, for Prometheus."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from genre_tasks.errors import ConfigError

# Seconds: a small image takes hundredths of a second, a batch of large ones several seconds.
_BUCKETS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)


class ServiceMetrics(Protocol):
    """Where a service counts what it does."""

    def count_request(self, method: str, status: str, seconds: float) -> None:
        """Counts an answered request.

        Args:
            method: of the protocol, one of a few.
            status: of the answer, in the protocol's own words.
            seconds: from the request to the answer.
        """
        ...

    def count_images(self, count: int) -> None:
        """Counts rendered images."""
        ...


class SilentMetrics:
    """Counts nothing; ``ServiceMetrics`` where nobody asks for numbers."""

    def count_request(self, method: str, status: str, seconds: float) -> None:
        """Counts nothing."""

    def count_images(self, count: int) -> None:
        """Counts nothing."""


class PrometheusMetrics:
    """Counts for Prometheus, and answers its requests at a port; ``ServiceMetrics``.

    Args:
        host: address to answer at.
        port: of the answers; 0: any free one.
        measure_queue: gives how many calls are rendered or wait.

    Raises:
        ConfigError: the package is not installed, or the port is taken.
    """

    def __init__(self, host: str, port: int, measure_queue: Callable[[], int]) -> None:
        try:
            import prometheus_client
        except ModuleNotFoundError as error:
            raise ConfigError(
                "--metrics-port needs the package prometheus_client",
                remedy="Install it: pip install 'genre[simulators]'.",
            ) from error
        # Numbers of this service alone, so that several may run in one process.
        registry = prometheus_client.CollectorRegistry()
        self._requests = prometheus_client.Counter(
            "genre_requests", "Answered requests.", ["method", "status"], registry=registry
        )
        self._seconds = prometheus_client.Histogram(
            "genre_request_seconds", "Seconds of a request.", ["method"], buckets=_BUCKETS, registry=registry
        )
        self._images = prometheus_client.Counter("genre_images", "Rendered images.", registry=registry)
        queue = prometheus_client.Gauge("genre_queue", "Calls that are rendered or wait.", registry=registry)
        queue.set_function(measure_queue)
        try:
            server, self._thread = prometheus_client.start_http_server(port, host, registry=registry)
        except (OSError, UnicodeError) as error:
            raise ConfigError(
                f"cannot listen at {host}, port {port} ({error})", remedy="Choose another --metrics-port."
            ) from error
        self._server: Any = server

    @property
    def port(self) -> int:
        """Where the numbers are."""
        return int(self._server.server_port)

    def count_request(self, method: str, status: str, seconds: float) -> None:
        """See ``ServiceMetrics``."""
        self._requests.labels(method, status).inc()
        self._seconds.labels(method).observe(seconds)

    def count_images(self, count: int) -> None:
        """See ``ServiceMetrics``."""
        self._images.inc(count)

    def close(self) -> None:
        """Frees the port."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
