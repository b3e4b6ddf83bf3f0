"""Scenes of the paper's methods, on which detectors look."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.common.bench import NotMeasuredError
from benchmarks.common.run_stages import print_progress
from flows.paper_tables.agreement_cells import front_camera_setting
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.paper_tables.layouts import PROTOCOL
from flows.pipeline.definition import STAGE_BY_NAME, digest_stage_weights, stages_until
from flows.pipeline.stage_runner import ArtifactRef, Job, read_artifact, run_stage
from genre_tasks.config import PipelineConfig
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph

METHOD = "genre+"
OTHER_METHODS = ("3dgs", "difix")
"""What it is compared with, keys of ``BUILT_IN``."""


@dataclass(frozen=True)
class PerceptionCase:
    """A chunk whose scenes are looked at.

    Attributes:
        log: URI of the log.
        chunk: number of the chunk.
        store: folder of the store.
        settings: ``section.key=value`` over the preset ``small`` and the paper's protocol.
    """

    log: str
    chunk: int
    store: str
    settings: tuple[str, ...]

    @property
    def name(self) -> str:
        """A short name, such as ``pandaset 002 chunk 1``."""
        # A folder of a real log, or the seed of a street.
        kind, _, rest = self.log.partition(":")
        part = rest.partition("?")[2].partition("&")[0] or rest.rpartition("/")[2]
        return f"{kind} {part} chunk {self.chunk}"

    def job(self, method: str) -> Job:
        """Builds the job of a method.

        Args:
            method: a key of ``BUILT_IN``.
        """
        config = BUILT_IN[method].configuration("small", (*PROTOCOL, *self.settings))
        return Job(self.log, self.chunk, self.store, config.model_dump(mode="json"))

    def describe(self, methods: tuple[str, ...]) -> dict[str, object]:
        """Says what the scenes depend on beyond the code, for the cells' cache.

        Args:
            methods: keys of ``BUILT_IN``.
        """
        configurations = {method: self.job(method).config for method in methods}
        # Other methods use no weights but the fixer's, which is the same.
        config = PipelineConfig.model_validate(configurations[METHOD])
        weights = [digest_stage_weights(STAGE_BY_NAME[stage], config) for stage in ("gnet", "fnet", "enet")]
        return {"log": self.log, "chunk": self.chunk, "configurations": configurations, "weights": weights}


def restrict_to_front_camera(case: PerceptionCase) -> PerceptionCase:
    """Gives the case whose scenes are of the front camera alone.

    Args:
        case: with all cameras.
    """
    # A setting and not another kind of case, so that stages find it in their keys.
    return replace(case, settings=(*case.settings, front_camera_setting(case.log)))


def run_method(case: PerceptionCase, method: str) -> tuple[Job, Mapping[str, ArtifactRef]]:
    """Runs the stages that the store lacks.

    Args:
        case: the chunk.
        method: a key of ``BUILT_IN``.
    """
    job = case.job(method)
    refs: dict[str, ArtifactRef] = {}
    for stage in stages_until(BUILT_IN[method].end):
        refs[stage] = run_stage(stage, job, refs)
        if not refs[stage].cached:
            print_progress(f"{case.name} {method} {stage}: done")
    return job, refs


def read_scene(case: PerceptionCase, method: str) -> tuple[Chunk, SceneGraph]:
    """Reads a method's scene, and its chunk with the plan's effects.

    Args:
        case: the chunk; stages that the store lacks are computed.
        method: a key of ``BUILT_IN``.
    """
    job, refs = run_method(case, method)
    # Renders need the lenses that the plan decided on.
    chunk = apply_plan(read_artifact(job, refs["ingest"]), read_artifact(job, refs["effects"]))
    return chunk, read_artifact(job, refs[BUILT_IN[method].end]).scene


def drop_missing(metrics: Mapping[str, float]) -> dict[str, float]:
    """Leaves out numbers that are not finite: JSON has no NaN, and what was not measured is missing.

    Args:
        metrics: by name.

    >>> drop_missing({"box/ap": 0.5, "box/iou": float("nan")})
    {'box/ap': 0.5}
    """
    return {name: value for name, value in metrics.items() if math.isfinite(value)}


def list_detectors(folder: str, names: tuple[str, ...]) -> dict[str, Path]:
    """Finds the files of detectors.

    Args:
        folder: that holds them.
        names: of the files.

    Returns:
        Their paths by name without ending.

    Raises:
        NotMeasuredError: one is missing.
    """
    paths = {Path(name).stem: Path(folder) / name for name in names}
    # Detectors do not ship; where they are missing the row says so.
    missing = [str(path) for path in paths.values() if not path.is_file()]
    if missing:
        raise NotMeasuredError(f"no detector {missing[0]}")
    return paths
