"""One effect on one log, on and off, all others as the plan has them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.context import threads
from benchmarks.common.run_stages import reconstruct, seconds_of
from benchmarks.common.task import value_of
from benchmarks.effects.cases import CASES
from benchmarks.effects.measures import beside_psnr, heldout_psnr
from flows.configuration import load_configuration
from flows.machine.facts import commit
from flows.pipeline.log_cache import opened_log
from flows.pipeline.stage_runner import Job
from genre_tasks.effects.apply_plan import applied
from genre_tasks.effects.measurements import Seen
from genre_tasks.effects.pixel_motion import pixel_speeds
from genre_tasks.effects.types import EffectsPlan, Fitted
from genre_tasks.logs.types import Truth
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph

STAGES = ("ingest", "effects", "initial", "gnet")


@dataclass(frozen=True)
class Place:
    """A chunk of a log, and the store that its stages are kept in."""

    log: str
    chunk: int
    store: str

    def job(self, *settings: str) -> Job:
        """Preset ``small`` with settings."""
        configuration = load_configuration("small", settings=settings).model_dump(mode="json")
        return Job(self.log, self.chunk, self.store, configuration)

    def plan(self, *settings: str) -> EffectsPlan:
        """Of the chunk, under settings."""
        job = self.job(*settings)
        found: EffectsPlan = value_of(job, reconstruct(job, STAGES[:2])["effects"])
        return found


def on_street(name: str, seed: str, store: str, factor: float) -> Row:
    """The effect on the street that calls for it so much; factor 0: on one that does not."""
    case = CASES[name]
    log = f"synthetic:street?seed={seed}{case.query(factor, _px_per_s(seed, store) if case.timed else 0.0)}"
    return measure(name, Place(log, 0, store), factor)


def on_real(name: str, path: str, chunk: int, store: str) -> Row:
    """The effect on a chunk of a PandaSet sequence."""
    if not Path(path).is_dir():
        raise NotMeasuredError(f"there is no folder {path}; give it with --set pandaset=PATH")
    return measure(name, Place(f"pandaset:{path}", chunk, store), -1.0)


def measure(name: str, at: Place, factor: float) -> Row:
    """The effect on and off: its measure, PSNR at 3 m, seconds of plan and GNet."""
    with threads():
        auto = at.plan()[name]
        out: Row = {"effect": name, "log": at.log, "chunk": at.chunk, "factor": factor, "unit": CASES[name].unit}
        out |= {"value": None if np.isnan(auto.value) else auto.value, "threshold": auto.threshold}
        out |= {"property_unit": auto.unit, "choice": auto.choice, "commit": commit()}
        own = at.plan(f"effects.{name}=on").fitted
        for word in ("on", "off"):
            out[word] = judged(at, own, CASES[name].measure, f"effects.{name}={word}")
    return out


def judged(
    at: Place, own: Fitted, by: Callable[[Chunk, SceneGraph, Truth | None], float], *settings: str
) -> dict[str, float | None]:
    """GNet's scene under settings; the vehicle itself, as ``own`` has it, is left out of the judgement."""
    job = at.job(*settings)
    refs = reconstruct(job, STAGES)
    read, plan, scene = (value_of(job, refs[k]) for k in ("ingest", "effects", "gnet"))
    shown = applied(read, replace(plan, fitted=replace(plan.fitted, own=own.own)))
    truth = opened_log(at.log).truth
    return {
        "measure": by(shown, scene.scene, truth),
        "heldout_db": heldout_psnr(shown, scene.scene),
        "beside_db": None if truth is None else beside_psnr(shown, scene.scene, truth),
        "gnet_s": seconds_of(job, refs["gnet"])[0],
        "plan_s": seconds_of(job, refs["effects"])[0],
    }


def _px_per_s(seed: str, store: str) -> float:
    """How fast the fastest camera of the plain street moves over the scene."""
    at = Place(f"synthetic:street?seed={seed}", 0, store)
    job = at.job()
    chunk: Chunk = value_of(job, reconstruct(job, STAGES[:1])["ingest"])
    speeds: Sequence[float] = list(pixel_speeds(Seen(chunk, opened_log(at.log).cameras)).values())
    if not speeds:
        raise NotMeasuredError(f"{at.log}: no camera moves over returns")
    return max(speeds)
