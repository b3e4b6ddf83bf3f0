"""Predicts what cells take before they run, from what is stored and what such stages usually take."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from flows.pipeline.definition import STAGE_BY_NAME
from flows.pipeline.prediction import median_stage_seconds
from flows.pipeline.stage_runner import ArtifactRef, Job, find_artifact
from genre_tasks.config import GnetConfig, PipelineConfig

PER_SCENE_METHODS = ("standard_3dgs", "street_gs")
PER_SCENE_ITERATION_S = 0.012
"""Seconds of one iteration of per-scene 3DGS at 320×180 on two cores; they grow with the pixels."""
_PER_SCENE_PIXELS = 320 * 180


def find_stored_stages(job: Job, names: Sequence[str]) -> dict[str, ArtifactRef]:
    """Looks up which stages of a job need no computation.

    Args:
        job: chunk, configuration and store.
        names: stages in the pipeline's order.

    Returns:
        The artifacts that are stored and whose inputs are stored too, by stage. A stage below a missing one is not
        found, as its key depends on the payload of the missing one.
    """
    refs: dict[str, ArtifactRef] = {}
    for name in names:
        spec = STAGE_BY_NAME[name]
        # A key needs the payloads of all inputs, so nothing below a gap can be looked up.
        if all(i in refs for i in spec.inputs):
            # A prediction must not delete anything, so a corrupt artifact is left for the run to repair.
            ref = find_artifact(spec, job, refs, repair=False).ref
            if ref is not None:
                refs[name] = ref
    return refs


class StagePredictor:
    """Predicts seconds cell by cell; a stage that an earlier cell computes costs the later ones nothing.

    A stage costs the median of such stages in the store, or a typical value where there is none. GNet and ENet cost in
    proportion to their rendered views, per-scene training by the iteration, and all stages in proportion to the pixels.
    """

    def __init__(self, store: str) -> None:
        self._store = store
        # Looked up once for each size of images: a store may hold many thousand artifacts.
        self._usual: dict[int, dict[str, float]] = {}
        self._computed: set[str] = set()

    def predict(self, cell: str, job: Job, base: PipelineConfig, names: Sequence[str]) -> dict[str, Any]:
        """Predicts one cell.

        Args:
            cell: name of the cell.
            job: the cell's chunk, configuration and store.
            base: the configuration that the usual seconds of a stage belong to.
            names: the cell's stages in the pipeline's order.

        Returns:
            ``cell``, its name; ``seconds`` to compute what is missing; ``cached``, how many stages are stored.
        """
        stored = find_stored_stages(job, names)
        config = PipelineConfig.model_validate(job.config)
        seconds = 0.0
        for name in names:
            # Keys cannot be known before the inputs are computed, so recipes stand in for them.
            identity = json.dumps([job.store, job.log, job.chunk, *_recipe(name, job)])
            if name not in stored and identity not in self._computed:
                seconds += self._seconds(name, config, base)
            # Added also when stored, so that a later cell with this recipe costs nothing either.
            self._computed.add(identity)
        return {"cell": cell, "seconds": seconds, "cached": f"{len(stored)} of {len(names)} stages"}

    def _seconds(self, name: str, config: PipelineConfig, base: PipelineConfig) -> float:
        section = getattr(config, STAGE_BY_NAME[name].section)
        # Stored medians of this stage are of the learned method, which is far quicker.
        if isinstance(section, GnetConfig) and section.method in PER_SCENE_METHODS:
            return section.per_scene.iterations * PER_SCENE_ITERATION_S * _pixels(config) / _PER_SCENE_PIXELS
        # A scene of another program is passed on as it is.
        if isinstance(section, GnetConfig) and section.method == "none":
            return 0.0
        if _pixels(base) not in self._usual:
            self._usual[_pixels(base)] = median_stage_seconds(self._store, base)
        # Stages are dominated by rasterising, whose time grows with the pixels.
        seconds = self._usual[_pixels(base)][name.partition("/")[0]] * (_pixels(config) / _pixels(base))
        # An iteration's cost is that of rendering its views, so their number is what scales.
        if name in ("gnet", "enet"):
            seconds *= _rendered_views(section) / _rendered_views(getattr(base, name))
        return seconds


def _recipe(stage: str, job: Job) -> list[Any]:
    """Gives what decides a stage's payload on one chunk: its configuration and that of all stages before it."""
    spec = STAGE_BY_NAME[stage]
    # Two cells share a stage only if everything before it is equal too.
    before = [part for name in spec.inputs for part in _recipe(name, job)]
    return [*before, stage, job.config[spec.section]]


def _pixels(config: PipelineConfig) -> int:
    return config.ingest.width_px * config.ingest.height_px


def _rendered_views(section: Any) -> int:
    return int(section.iterations * (section.views_per_iteration + section.novel_views_per_iteration))
