"""The metrics that workers count, by name: the exporter, the documents and the dashboards go by this table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class MetricDefinition:
    """One metric.

    Attributes:
        name: for Prometheus; counters end in ``_total``.
        kind: what it is for Prometheus.
        help: what it counts, one sentence.
        labels: names of its labels.
        buckets: upper ends of a histogram's buckets, ascending, without the infinite one.
    """

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    help: str
    labels: tuple[str, ...] = ("stage",)
    buckets: tuple[float, ...] = ()


# A look-up in the store takes hundredths of a second, a scene of many cameras an hour.
_SECONDS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)

STAGES = MetricDefinition("genre_stages_total", "counter", "Stages that ended, by outcome.", ("stage", "outcome"))
STAGE_SECONDS = MetricDefinition(
    "genre_stage_seconds", "histogram", "Wall time of stages, in seconds.", ("stage", "outcome"), _SECONDS
)
CACHE_HITS = MetricDefinition("genre_cache_hits_total", "counter", "Stages that the store had already.")
BYTES_READ = MetricDefinition("genre_artifact_bytes_read_total", "counter", "Bytes of the artifacts that stages read.")
BYTES_WRITTEN = MetricDefinition(
    "genre_artifact_bytes_written_total", "counter", "Bytes of the artifacts that stages committed."
)
RETRIES = MetricDefinition("genre_stage_retries_total", "counter", "Further attempts at stages.")
LEASE_WAITS = MetricDefinition(
    "genre_lease_waits_total", "counter", "Times that a stage waited for another process that computed the same."
)
LEASE_WAIT_SECONDS = MetricDefinition("genre_lease_wait_seconds_total", "counter", "Seconds of these waits.")
RUNNING_STAGES = MetricDefinition("genre_running_stages", "gauge", "Stages that run now.")

METRICS = (
    STAGES,
    STAGE_SECONDS,
    CACHE_HITS,
    BYTES_READ,
    BYTES_WRITTEN,
    RETRIES,
    LEASE_WAITS,
    LEASE_WAIT_SECONDS,
    RUNNING_STAGES,
)
"""All of them, in the order of the documents."""

OUTCOMES = ("computed", "cached", "failed")
"""How a stage may end."""
