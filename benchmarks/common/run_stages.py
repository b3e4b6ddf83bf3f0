"""Runs pipeline stages without Prefect, and reads their metrics and seconds from the store."""

from __future__ import annotations

import sys

from flows.pipeline.definition import PIPELINE
from flows.pipeline.stage_runner import ArtifactRef, Job, produce
from storage.local import open_store

SETTINGS = ("evaluate.shifts_m=[3]",)
"""Claims are made at 3 m; the other shifts would only cost time."""


ALL_STAGES = tuple(spec.name for spec in PIPELINE)


def reconstruct(job: Job, stages: tuple[str, ...] = ALL_STAGES) -> dict[str, ArtifactRef]:
    """The named stages of one chunk, in order."""
    refs: dict[str, ArtifactRef] = {}
    for spec in PIPELINE:
        if spec.name in stages:
            refs[spec.name] = produce(spec.name, job, {name: refs[name] for name in spec.inputs})
            say(f"{job.log} chunk {job.chunk} {spec.name}: {'cached' if refs[spec.name].cached else 'done'}")
    return refs


def metrics_of(job: Job, ref: ArtifactRef) -> dict[str, float]:
    """Metric values of an ``evaluate/…`` artifact, intervals as ``…/low`` and ``…/high``."""
    store = open_store(job.store)
    (artifact,) = store.artifacts(key=ref.key, chunk=job.chunk)
    out: dict[str, float] = {}
    for metric in store.read(artifact).metrics:
        out[metric.name] = metric.value
        if metric.low is not None and metric.high is not None:
            out |= {f"{metric.name}/low": metric.low, f"{metric.name}/high": metric.high}
    return out


def seconds_of(job: Job, ref: ArtifactRef) -> tuple[float, float]:
    """Seconds and peak MiB of a stage, from its manifest."""
    (artifact,) = open_store(job.store).artifacts(key=ref.key, chunk=job.chunk)
    return artifact.manifest.seconds, artifact.manifest.peak_mib


def say(text: str) -> None:
    sys.stderr.write(text + "\n")
