"""Counts of this process, written to the folder that the environment names; without it nothing is counted."""

from __future__ import annotations

import logging
import os
import threading
from bisect import bisect_left

from flows.observability.counter_files import CounterFolder, Counts, Sample, add_counts
from flows.observability.metric_definitions import MetricDefinition
from genre_tasks.user_paths import expand_user_path

METRICS_FOLDER = "GENRE_METRICS_DIR"
"""The variable of the environment that names the folder. The workers of one exporter share it."""

_log = logging.getLogger("genre.metrics")


class ProcessCounters:
    """Counts of one process.

    Args:
        folder: of the files of all processes.
    """

    def __init__(self, folder: CounterFolder) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._has_failed = False
        # What the file holds; None before it is written.
        self._saved: dict[Sample, float] | None = None
        self._start_file(Counts())
        try:
            folder.fold_if_many()
        except OSError as error:
            self._report(error)

    def add(self, metric: MetricDefinition, *labels: str, amount: float = 1.0) -> None:
        """Adds to a counter or a gauge; it counts from the next :meth:`save` on.

        Args:
            metric: the metric.
            labels: the values of its labels.
            amount: what to add; negative for a gauge that goes down.
        """
        self._add((metric.name, *labels), amount, is_gauge=metric.kind == "gauge")

    def observe(self, metric: MetricDefinition, *labels: str, value: float) -> None:
        """Adds a value to a histogram; it counts from the next :meth:`save` on.

        Args:
            metric: the metric.
            labels: the values of its labels.
            value: the value.
        """
        self._add(name_bucket(metric, labels, value), 1.0)
        self._add((f"{metric.name}_sum", *labels), value)

    def save(self) -> None:
        """Writes the counts. A folder that cannot be written is reported once, and never ends a stage."""
        with self._lock:
            self._forget_parent()
            try:
                if self._saved is not None and not self._path.exists():
                    # Folded by a process that took this one for ended: what is in the totals must not count twice.
                    unsaved: dict[Sample, float] = dict(self._counts.totals)
                    add_counts(unsaved, {sample: -value for sample, value in self._saved.items()})
                    self._start_file(Counts(unsaved, self._counts.running))
                self._folder.write(self._path, self._counts)
                self._saved = dict(self._counts.totals)
            except OSError as error:
                self._report(error)

    def _add(self, sample: Sample, amount: float, is_gauge: bool = False) -> None:
        with self._lock:
            self._forget_parent()
            counts = self._counts.running if is_gauge else self._counts.totals
            add_counts(counts, {sample: amount})

    def _forget_parent(self) -> None:
        # A forked process begins with the counts of its parent, which writes them itself.
        if self._process != os.getpid():
            self._start_file(Counts())

    def _start_file(self, counts: Counts) -> None:
        self._process = os.getpid()
        self._path = self._folder.name_file()
        self._counts = counts
        self._saved = None

    def _report(self, error: OSError) -> None:
        if not self._has_failed:
            _log.warning("metrics cannot be written, so counts will be missing: %s", error)
        self._has_failed = True


def name_bucket(metric: MetricDefinition, labels: tuple[str, ...], value: float) -> Sample:
    """Names the bucket of a histogram that a value belongs to.

    Args:
        metric: the histogram.
        labels: the values of its labels.
        value: the value.

    Returns:
        The sample of the bucket, whose last label is its upper end.
    """
    position = bisect_left(metric.buckets, value)
    end = str(metric.buckets[position]) if position < len(metric.buckets) else "+Inf"
    return (f"{metric.name}_bucket", *labels, end)


_counters: dict[str, ProcessCounters] = {}


def get_counters() -> ProcessCounters | None:
    """Gives the counts of this process.

    Returns:
        The counts, or ``None`` where :data:`METRICS_FOLDER` is not set.

    Raises:
        InputError: the folder begins with a ``~`` that stands for no home folder.
    """
    folder = os.environ.get(METRICS_FOLDER)
    if not folder:
        return None
    if folder not in _counters:
        _counters[folder] = ProcessCounters(CounterFolder(expand_user_path(folder)))
    return _counters[folder]
