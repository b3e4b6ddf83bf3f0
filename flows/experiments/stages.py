"""Runs the stages of one cell, and reads what they cost and what their evaluation found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from flows.pipeline.definition import STAGE_BY_NAME
from flows.pipeline.progress import get_reporter
from flows.pipeline.stage_runner import ArtifactRef, Job, open_artifact, run_stage

if TYPE_CHECKING:
    from genre_tasks.metrics.results import Metric

StageRunner = Callable[[str, Job, dict[str, ArtifactRef]], ArtifactRef]
"""Gives the artifact of a stage, a job and the stage's inputs, as ``run_stage`` does."""


def run_reported_stage(stage: str, job: Job, inputs: dict[str, ArtifactRef]) -> ArtifactRef:
    """Runs a stage and sends its progress to this process's reporter.

    Args:
        stage: name of the stage.
        job: chunk, configuration and store.
        inputs: artifacts of the earlier stages that it reads, by stage.

    Returns:
        The stage's artifact, from the store where a verified one is there.
    """
    return run_stage(stage, job, inputs, progress=get_reporter().progress)


def run_stages(names: Iterable[str], job: Job, runner: StageRunner) -> dict[str, ArtifactRef]:
    """Runs several stages of one chunk.

    Args:
        names: the stages in the pipeline's order, each after all of its inputs.
        job: chunk, configuration and store.
        runner: runs one stage.

    Returns:
        The artifacts, by stage.
    """
    refs: dict[str, ArtifactRef] = {}
    for name in names:
        refs[name] = runner(name, job, {i: refs[i] for i in STAGE_BY_NAME[name].inputs})
    return refs


@dataclass(frozen=True)
class StageCosts:
    """What the stages of a cell took when they were computed, which may have been in an earlier run.

    Attributes:
        seconds: wall time by stage.
        cpu_seconds: time of all threads by stage; ``None`` for an artifact that was made before it was counted.
        peak_mib: peak of the process's resident memory over the stages, MiB.
    """

    seconds: Mapping[str, float]
    cpu_seconds: Mapping[str, float | None]
    peak_mib: float


def read_stage_costs(job: Job, refs: Mapping[str, ArtifactRef]) -> StageCosts:
    """Reads from the manifests what stages took.

    Args:
        job: the job that the artifacts belong to.
        refs: at least one artifact, by stage.

    Raises:
        ArtifactCorruptError: an artifact is gone.
    """
    # From the manifests, because a stage that came from the store has no seconds of its own in this run.
    manifests = {name: open_artifact(job, ref).manifest for name, ref in refs.items()}
    return StageCosts(
        seconds={name: m.seconds for name, m in manifests.items()},
        cpu_seconds={name: m.measurements.get("cpu_seconds") for name, m in manifests.items()},
        # The peak and not the sum: stages run one after the other in one process.
        peak_mib=max(m.peak_mib for m in manifests.values()),
    )


def metric_values(metrics: Sequence[Metric]) -> dict[str, float]:
    """Gives the values of an evaluation by name, such as ``interpolation/psnr``."""
    return {m.name: m.value for m in metrics}


def image_counts(metrics: Sequence[Metric]) -> dict[str, int]:
    """Counts the images behind an evaluation.

    Args:
        metrics: of one evaluation.

    Returns:
        ``GROUP/n`` → number of images, for each group of views such as ``interpolation`` or ``shift_3m``.
    """
    return {m.name.rpartition("/")[0] + "/n": m.n for m in metrics}


def interval_bounds(metrics: Sequence[Metric]) -> dict[str, float]:
    """Gives the bounds of 95 % confidence intervals.

    Args:
        metrics: of one evaluation.

    Returns:
        ``NAME/low`` and ``NAME/high`` for each metric that has an interval.
    """
    bounds: dict[str, float] = {}
    for m in metrics:
        # Metrics of a whole set, such as kernel distances, may have no interval.
        if m.low is not None and m.high is not None:
            bounds[f"{m.name}/low"] = m.low
            bounds[f"{m.name}/high"] = m.high
    return bounds
