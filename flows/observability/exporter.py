"""Answers Prometheus with the counts of all processes of a folder: ``python -m flows.observability.exporter``."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows.observability.counter_files import CounterFolder, Sample
from flows.observability.metric_definitions import METRICS, MetricDefinition
from flows.observability.process_counters import METRICS_FOLDER
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.user_paths import expand_user_path

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry
    from prometheus_client.metrics_core import Metric

METRICS_PORT = "GENRE_METRICS_PORT"
"""The variable of the environment that names the port of the exporter; 0 for any free one."""

HOST = "127.0.0.1"
_IDLE_S = 3600.0


class FolderCollector:
    """Reads the counts of a folder whenever Prometheus asks; a collector of ``prometheus_client``.

    Args:
        folder: that the processes count in.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = CounterFolder(folder)

    def collect(self) -> Iterator[Metric]:
        """Adds up the files.

        Yields:
            Every metric, also those that nothing has counted yet.

        Raises:
            OSError: the folder cannot be written.
        """
        counts = self._folder.read()
        for metric in METRICS:
            yield _build_family(metric, counts.running if metric.kind == "gauge" else counts.totals)


@contextmanager
def serve_metrics(folder: Path, port: int) -> Iterator[int]:
    """Answers at a port of this machine while the block runs.

    Args:
        folder: that the processes count in.
        port: 0 for any free one.

    Yields:
        The port.

    Raises:
        ConfigError: the package ``prometheus_client`` is missing, or the port is taken.

    Example::

        with serve_metrics(Path("/var/lib/genre/metrics"), 9464):
            worker.wait()
    """
    registry = make_registry(folder)
    from prometheus_client import start_http_server

    try:
        server, thread = start_http_server(port, HOST, registry=registry)
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"cannot listen at {HOST}, port {port} ({error})", remedy=f"Choose another {METRICS_PORT}."
        ) from error
    try:
        yield int(server.server_port)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@contextmanager
def serve_metrics_if_asked(environment: Mapping[str, str] = os.environ) -> Iterator[int | None]:
    """Does as :func:`serve_metrics` where the environment names a folder and a port, and else nothing.

    Args:
        environment: the variables.

    Yields:
        The port, or ``None``.

    Raises:
        ConfigError: as :func:`serve_metrics`, or only one of the variables is set, or the port is no number.
        InputError: as :func:`read_metrics_address`.

    >>> with serve_metrics_if_asked({}) as port:
    ...     print(port)
    None
    """
    if not environment.get(METRICS_PORT):
        yield None
        return
    folder, port = read_metrics_address(environment)
    with serve_metrics(folder, port) as bound_port:
        yield bound_port


def read_metrics_address(environment: Mapping[str, str]) -> tuple[Path, int]:
    """Reads where processes count and where the exporter answers.

    Args:
        environment: the variables.

    Returns:
        Folder and port.

    Raises:
        ConfigError: a variable is missing, or the port is no number.
        InputError: the folder begins with a ``~`` that stands for no home folder.

    >>> read_metrics_address({"GENRE_METRICS_DIR": "/tmp/counts", "GENRE_METRICS_PORT": "9464"})
    (PosixPath('/tmp/counts'), 9464)
    """
    folder = environment.get(METRICS_FOLDER)
    port = environment.get(METRICS_PORT, "")
    if not folder:
        raise ConfigError(f"{METRICS_FOLDER} is not set", remedy="Set it to the folder that workers count in.")
    if not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"{METRICS_PORT}={port} is no port", remedy="Set it to a number from 0 to 65535.")
    return expand_user_path(folder), int(port)


def make_registry(folder: Path) -> CollectorRegistry:
    """Makes a registry with the counts of a folder alone.

    Args:
        folder: that the processes count in.

    Returns:
        The registry, for ``prometheus_client.generate_latest``.

    Raises:
        ConfigError: the package is not installed.
    """
    try:
        from prometheus_client import CollectorRegistry
    except ModuleNotFoundError as error:
        raise ConfigError(
            "metrics need the package prometheus_client", remedy="Install it: pip install 'genre[metrics]'."
        ) from error
    registry = CollectorRegistry()
    registry.register(FolderCollector(folder))
    return registry


def main() -> None:
    """Answers until it is stopped; the environment names folder and port.

    Raises:
        SystemExit: the environment is wrong, or the port is taken.
    """
    try:
        folder, port = read_metrics_address(os.environ)
        with serve_metrics(folder, port) as bound_port:
            sys.stderr.write(f"metrics of {folder} at http://{HOST}:{bound_port}/metrics\n")
            sys.stderr.flush()
            while True:
                time.sleep(_IDLE_S)
    except (ConfigError, InputError) as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        # How a terminal stops it; there is nothing to save.
        return


def _build_family(metric: MetricDefinition, counts: Mapping[Sample, float]) -> Metric:
    from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily

    if metric.kind == "histogram":
        family: Any = HistogramMetricFamily(metric.name, metric.help, labels=metric.labels)
        for labels, buckets, total in _gather_histograms(metric, counts):
            family.add_metric(labels, buckets=buckets, sum_value=total)
        return family
    kind = GaugeMetricFamily if metric.kind == "gauge" else CounterMetricFamily
    family = kind(metric.name, metric.help, labels=metric.labels)
    for (name, *labels), value in sorted(counts.items()):
        if name == metric.name:
            family.add_metric(labels, value)
    return family


def _gather_histograms(
    metric: MetricDefinition, counts: Mapping[Sample, float]
) -> Iterator[tuple[list[str], list[tuple[str, float]], float]]:
    """Labels, cumulative buckets and sum of each set of labels."""
    ends = [*map(str, metric.buckets), "+Inf"]
    for (name, *labels), total in sorted(counts.items()):
        if name != f"{metric.name}_sum":
            continue
        counted = [
            (float(sample[-1]), value)
            for sample, value in counts.items()
            if sample[0] == f"{metric.name}_bucket" and list(sample[1:-1]) == labels
        ]
        # Counts of a version with other buckets go to the next larger one.
        yield labels, [(end, sum(n for limit, n in counted if limit <= float(end))) for end in ends], total


if __name__ == "__main__":
    main()
