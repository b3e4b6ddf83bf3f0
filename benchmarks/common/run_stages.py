"""Runs pipeline stages without Prefect, and reads their metrics from the store."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from flows.experiments.stages import interval_bounds, metric_values, run_stages
from flows.experiments.warm_up import run_on_tiny_log
from flows.pipeline.definition import PIPELINE
from flows.pipeline.stage_runner import ArtifactRef, Job, read_artifact, run_stage
from genre_tasks.config import PipelineConfig

SETTINGS = ("evaluate.shifts_m=[3]",)
"""Claims are made at 3 m; the other shifts would only cost time."""

ALL_STAGES = tuple(spec.name for spec in PIPELINE)


def reconstruct(job: Job, stages: Sequence[str] = ALL_STAGES) -> dict[str, ArtifactRef]:
    """Runs stages of one chunk, and says on stderr which one has ended.

    Args:
        job: chunk, configuration and store.
        stages: names of stages; they run in the pipeline's order.

    Returns:
        The artifacts, by stage.
    """
    # The pipeline's order whatever the caller's: inputs have to come first.
    return run_stages([name for name in ALL_STAGES if name in stages], job, _run_and_say)


def _run_and_say(stage: str, job: Job, inputs: dict[str, ArtifactRef]) -> ArtifactRef:
    ref = run_stage(stage, job, inputs)
    print_progress(f"{job.log} chunk {job.chunk} {stage}: {'cached' if ref.cached else 'done'}")
    return ref


def warm_up(configuration: Mapping[str, Any], stages: Sequence[str]) -> None:
    """Runs stages on a tiny log, once for each process: the stages that are timed next pay for no imports and weights.

    Args:
        configuration: the pipeline's, as plain values.
        stages: names of stages in the pipeline's order.
    """
    _warm_up_once(json.dumps(configuration, sort_keys=True), tuple(stages))


# All cells of a benchmark have one configuration, and a warm process stays warm.
@lru_cache(maxsize=1)
def _warm_up_once(configuration: str, stages: tuple[str, ...]) -> None:
    run_on_tiny_log(PipelineConfig.model_validate_json(configuration), stages)


def read_metrics(job: Job, ref: ArtifactRef) -> dict[str, float]:
    """Reads the metrics of an evaluation.

    Args:
        job: the job that the artifact belongs to.
        ref: artifact of a stage ``evaluate/…``.

    Returns:
        Values by name, and bounds of 95 % intervals as ``…/low`` and ``…/high``.
    """
    metrics = read_artifact(job, ref).metrics
    return metric_values(metrics) | interval_bounds(metrics)


def print_progress(text: str) -> None:
    """Prints a line to stderr: stdout is for tables."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()
