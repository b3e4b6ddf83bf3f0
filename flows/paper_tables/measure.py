"""One cell of a table: a method on a chunk, from the store's stages as far as they are there."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from flows.experiments.log_chunks import LogChunk
from flows.experiments.stages import (
    StageRunner,
    image_counts,
    interval_bounds,
    metric_values,
    read_stage_costs,
    run_stages,
)
from flows.experiments.warm_up import run_on_tiny_log
from flows.paper_tables.columns import MeasuredCell
from flows.paper_tables.layouts import Layout
from flows.paper_tables.methods import Method
from flows.pipeline.definition import PIPELINE, stages_until
from flows.pipeline.stage_runner import ArtifactRef, Job, read_artifact

PRESET_METHOD = Method("the preset", ())


@dataclass(frozen=True)
class Basis:
    """What all methods of a table share.

    Attributes:
        preset: name of the preset.
        settings: the user's ``section.key=value`` over the preset and over the protocol.
        store: folder of the store.
    """

    preset: str
    settings: tuple[str, ...]
    store: str

    def job(self, layout: Layout, method: Method, where: LogChunk) -> Job:
        """Builds the job of a cell.

        Args:
            layout: the table, whose protocol comes after the preset.
            method: its settings come last, as they are what makes it that method.
            where: the chunk.

        Raises:
            ConfigError: a setting is unknown or out of range.
        """
        # The user's settings come after the protocol, which they may change, and before the method, which they may not.
        config = method.configuration(self.preset, (*layout.protocol, *self.settings))
        return Job(where.log, where.chunk, self.store, config.model_dump(mode="json"))


def list_stages(layout: Layout, method: Method) -> tuple[str, ...]:
    """Lists the stages of a cell in the pipeline's order.

    Args:
        layout: the table.
        method: the row's method.

    Returns:
        The stages up to the method's end, and its evaluation where the table has one.
    """
    stages = set(stages_until(method.end))
    if layout.evaluated:
        stages.add(f"evaluate/{method.end}")
    # The pipeline's order puts an evaluation after all of its inputs.
    return tuple(spec.name for spec in PIPELINE if spec.name in stages)


def measure_cell(basis: Basis, layout: Layout, method: Method, where: LogChunk, runner: StageRunner) -> MeasuredCell:
    """Measures a method on a chunk.

    Args:
        basis: what all methods share.
        layout: the table.
        method: the row's method.
        where: the chunk.
        runner: runs one stage.

    Returns:
        The cell.

    Raises:
        GenreError: as the stages raise it.
    """
    job = basis.job(layout, method, where)
    refs = run_stages(list_stages(layout, method), job, runner)
    metrics = _read_metrics(job, refs[f"evaluate/{method.end}"]) if layout.evaluated else {}
    return build_cell(method, where, job, refs, metrics)


def build_cell(
    method: Method, where: LogChunk, job: Job, refs: Mapping[str, ArtifactRef], metrics: dict[str, float]
) -> MeasuredCell:
    """Builds the cell of a method on a chunk, with what its stages cost.

    Args:
        method: the row's method.
        where: the chunk.
        job: of the cell.
        refs: its stages' artifacts; those of evaluations cost nothing.
        metrics: what was measured.
    """
    costs = read_stage_costs(job, {name: ref for name, ref in refs.items() if not name.startswith("evaluate/")})
    # A fixer's result is images; the scene that they were rendered from is GNet's.
    scene_stage = "gnet" if method.end == "fnet" else method.end
    return MeasuredCell(
        method=method.name,
        log=where.log,
        chunk=where.chunk,
        seconds=costs.seconds,
        # NaN and not zero: an artifact from before CPU seconds were counted did cost some.
        cpu_seconds={name: math.nan if s is None else float(s) for name, s in costs.cpu_seconds.items()},
        metrics=metrics,
        gaussians=len(read_artifact(job, refs[scene_stage]).scene),
        fixed_views=len(read_artifact(job, refs["fnet"]).views) if "fnet" in refs else 0,
    )


def _read_metrics(job: Job, ref: ArtifactRef) -> dict[str, float]:
    metrics = read_artifact(job, ref).metrics
    counts = {name: float(n) for name, n in image_counts(metrics).items()}
    return metric_values(metrics) | counts | interval_bounds(metrics)


def warm_up(basis: Basis, layout: Layout) -> None:
    """Runs the preset to its end on a tiny log, so that imports, weights and first calls are in no cell's seconds.

    Args:
        basis: the preset and the user's settings.
        layout: the table, whose stages are run.
    """
    config = PRESET_METHOD.configuration(basis.preset, (*layout.protocol, *basis.settings))
    run_on_tiny_log(config, list_stages(layout, PRESET_METHOD))
