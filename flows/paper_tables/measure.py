"""One cell of a table: a method on a chunk, from the store's stages as far as they are there."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flows.paper_tables.layouts import Cell, Layout
from flows.paper_tables.methods import Method
from flows.pipeline.definition import BY_NAME, PIPELINE, reconstructing_until
from flows.pipeline.log_cache import chosen_chunks, expanded
from flows.pipeline.stage_runner import ArtifactRef, Job, artifact_of, value_of
from genre_tasks.config import PipelineConfig

Produce = Callable[[str, Job, dict[str, ArtifactRef]], ArtifactRef]


@dataclass(frozen=True)
class Place:
    """A chunk of a log."""

    log: str
    chunk: int

    def __str__(self) -> str:
        return f"{self.log} chunk {self.chunk}"


@dataclass(frozen=True)
class Basis:
    """What all methods of a table share: the preset, the user's settings over it and over the protocol, the store."""

    preset: str
    settings: tuple[str, ...]
    store: str

    def job(self, layout: Layout, method: Method, place: Place) -> Job:
        """The method's settings come last: they are what makes it that method."""
        config = method.configuration(self.preset, (*layout.protocol, *self.settings))
        return Job(place.log, place.chunk, self.store, config.model_dump(mode="json"))


def stages_of(layout: Layout, method: Method) -> tuple[str, ...]:
    """The stages of a cell, in their order: up to the method's end, and its evaluation where the table has one."""
    stages = set(reconstructing_until(method.end))
    if layout.evaluated:
        stages.add(f"evaluate/{method.end}")
    return tuple(spec.name for spec in PIPELINE if spec.name in stages)


def run_stages(names: Sequence[str], job: Job, produce: Produce) -> dict[str, ArtifactRef]:
    """The artifacts of stages that are named in their order, by stage."""
    refs: dict[str, ArtifactRef] = {}
    for name in names:
        refs[name] = produce(name, job, {i: refs[i] for i in BY_NAME[name].inputs})
    return refs


def measure(basis: Basis, layout: Layout, method: Method, place: Place, produce: Produce) -> Cell:
    """The cell; raises as the stages do."""
    job = basis.job(layout, method, place)
    refs = run_stages(stages_of(layout, method), job, produce)
    manifests = {name: artifact_of(job, ref).manifest for name, ref in refs.items() if not name.startswith("evaluate/")}
    cpu = {name: m.measurements.get("cpu_seconds") for name, m in manifests.items()}
    metrics: dict[str, float] = {}
    if layout.evaluated:
        for m in value_of(job, refs[f"evaluate/{method.end}"]).metrics:
            metrics |= {m.name: m.value, m.name.rpartition("/")[0] + "/n": float(m.n)}
            if m.low is not None and m.high is not None:
                metrics |= {f"{m.name}/low": m.low, f"{m.name}/high": m.high}
    return Cell(
        method.name,
        place.log,
        place.chunk,
        {name: m.seconds for name, m in manifests.items()},
        {name: math.nan if value is None else float(value) for name, value in cpu.items()},
        metrics,
        len(value_of(job, refs["gnet" if method.end == "fnet" else method.end]).scene),
        len(value_of(job, refs["fnet"]).views) if "fnet" in refs else 0,
    )


def places_of(logs: Sequence[str], chunks: list[int] | None, config: PipelineConfig) -> list[Place]:
    """Every chosen chunk of every log. Raises ``InputError`` for a chunk that a log does not have."""
    return [Place(log, chunk) for log in expanded(list(logs)) for chunk in chosen_chunks(log, config, chunks)]
