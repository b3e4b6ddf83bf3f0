"""One effect on one log, on and off, all others as the plan has them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.context import THREADS
from benchmarks.common.run_stages import reconstruct
from benchmarks.common.task import require_log_folder
from benchmarks.effects.cases import CASES
from benchmarks.effects.measures import SceneMeasure, heldout_psnr, novel_view_psnr
from flows.configuration import load_configuration
from flows.machine.facts import git_commit
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import Job, open_artifact, read_artifact
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.effects.measurements import ChunkMeasurements
from genre_tasks.effects.pixel_motion import measure_pixel_speeds
from genre_tasks.effects.plan import load_effect
from genre_tasks.effects.types import EffectParameters, EffectsPlan
from genre_tasks.threads import torch_threads

STAGES = ("ingest", "effects", "initial", "gnet")


@dataclass(frozen=True)
class ChunkLocation:
    """A chunk of a log, the store that its stages are kept in, and what all of its runs share.

    Attributes:
        log: URI of the log.
        chunk: index of the chunk.
        store: folder of the store.
        settings: ``section.key=value`` over the preset ``small``.
    """

    log: str
    chunk: int
    store: str
    settings: tuple[str, ...] = ()

    def job(self, *settings: str) -> Job:
        """Builds a job with further settings over the preset."""
        config = load_configuration("small", settings=(*self.settings, *settings))
        return Job(self.log, self.chunk, self.store, config.model_dump(mode="json"))

    def plan(self, *settings: str) -> EffectsPlan:
        """Gives the chunk's plan of effects under further settings."""
        job = self.job(*settings)
        plan: EffectsPlan = read_artifact(job, reconstruct(job, STAGES[:2])["effects"])
        return plan


def measure_on_street(name: str, seed: str, store: str, settings: tuple[str, ...], factor: float) -> Row:
    """Measures an effect on a street.

    Args:
        name: of the effect.
        seed: of the street, with further parameters of its URI if need be.
        store: folder of the store.
        settings: ``section.key=value`` over the preset.
        factor: by which factor the property exceeds the effect's threshold; 0 for a street that does not call for it.

    Raises:
        NotMeasuredError: no camera of the street moves, and the effect's query needs its speed.
    """
    case = CASES[name]
    plain = ChunkLocation(f"synthetic:street?seed={seed}", 0, store, settings)
    # Measured on the same street: a duration means as many pixels only at that street's speed.
    px_per_s = _fastest_camera_px_per_s(plain) if case.needs_speed else 0.0
    return measure_effect(name, replace(plain, log=plain.log + case.query(factor, px_per_s)), factor)


def measure_on_pandaset(name: str, location: ChunkLocation) -> Row:
    """Measures an effect on a chunk of a real sequence.

    Raises:
        NotMeasuredError: the sequence's folder is missing, or what the effect needs is not in it.
    """
    require_log_folder(location.log)
    missing = load_effect(name).find_missing(_read_measurements(location))
    # A plan refuses such an effect, and its error would end the benchmark before the cells that follow.
    if missing is not None:
        raise NotMeasuredError(f"{location.log}: {missing}")
    return measure_effect(name, location, factor=-1.0)


def measure_effect(name: str, location: ChunkLocation, factor: float) -> Row:
    """Measures an effect on and off.

    Args:
        name: of the effect.
        location: the chunk.
        factor: see :func:`measure_on_street`; negative on a real log.

    Returns:
        A row: what decides about the effect, and ``on`` and ``off``, see :func:`evaluate_settings`.
    """
    with torch_threads(THREADS):
        # The plan is made of the log alone, before the effect is forced on or off.
        planned = location.plan()[name]
        row: Row = {
            "effect": name,
            "log": location.log,
            "chunk": location.chunk,
            "factor": factor,
            "unit": CASES[name].unit,
            # JSON has no NaN.
            "value": None if np.isnan(planned.value) else planned.value,
            "threshold": planned.threshold,
            "property_unit": planned.unit,
            "choice": planned.choice,
            "commit": git_commit(),
        }
        # Masks come from one plan for both states, else the two would be compared on different pixels.
        parameters = location.plan(f"effects.{name}=on").parameters
        for state in ("on", "off"):
            row[state] = evaluate_settings(location, parameters, CASES[name].measure, f"effects.{name}={state}")
    return row


def evaluate_settings(
    location: ChunkLocation, parameters: EffectParameters, measure: SceneMeasure, *settings: str
) -> dict[str, float | None]:
    """Evaluates GNet's scene under settings.

    Args:
        location: the chunk.
        parameters: their masks of the recording vehicle leave it out of the evaluation, whatever the settings are.
        measure: what the scene is evaluated by.
        settings: ``section.key=value`` over the preset.

    Returns:
        ``measure``; PSNR held out and at ±3 m (``None`` without truth) in dB; seconds of GNet and of the plan.

    Raises:
        NotMeasuredError: nothing in the views is what the measure is about.
    """
    job = location.job(*settings)
    refs = reconstruct(job, STAGES)
    plan = read_artifact(job, refs["effects"])
    scene = read_artifact(job, refs["gnet"]).scene
    # Otherwise switching the ego mask would change which pixels are compared, not only what was fitted to them.
    evaluated = replace(plan, parameters=replace(plan.parameters, ego_masks=parameters.ego_masks))
    chunk = apply_plan(read_artifact(job, refs["ingest"]), evaluated)
    truth = cached_log(location.log).truth
    value = measure(chunk, scene, truth)
    # JSON has no NaN: it would end the benchmark, and all cells that follow.
    if not math.isfinite(value):
        raise NotMeasuredError(f"{location.log}: no pixel of the views is what the measure is about")
    return {
        "measure": value,
        "heldout_db": heldout_psnr(chunk, scene),
        "beside_db": None if truth is None else novel_view_psnr(chunk, scene, truth),
        "gnet_s": open_artifact(job, refs["gnet"]).manifest.seconds,
        "plan_s": open_artifact(job, refs["effects"]).manifest.seconds,
    }


def _fastest_camera_px_per_s(location: ChunkLocation) -> float:
    speeds = measure_pixel_speeds(_read_measurements(location)).values()
    # A standing camera shears and blurs nothing, so no duration reaches the threshold.
    if not speeds:
        raise NotMeasuredError(f"{location.log}: no camera moves over returns")
    return max(speeds)


def _read_measurements(location: ChunkLocation) -> ChunkMeasurements:
    job = location.job()
    chunk = read_artifact(job, reconstruct(job, STAGES[:1])["ingest"])
    return ChunkMeasurements(chunk, cached_log(location.log).cameras)
