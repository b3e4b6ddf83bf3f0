"""What each effect brings where a log calls for it, and loses where it is left out of one that does not.

genre bench effects --json docs/benchmarks/effects.json [--set seeds=1001] [--set effects=exposure] [--set pandaset=]
genre bench effects --set seeds=900,901 --set factors=0.5,1,2,4    # where a threshold sits: see `Case`
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.bench import Cell, NotMeasuredError, Row
from benchmarks.main_job import reconstruct, seconds_of
from benchmarks.optimiser.beyond import over_cells
from benchmarks.optimiser.cells import threads
from benchmarks.optimiser.task import value_of
from benchmarks.schema import Claim, Op
from flows.configuration import load_configuration
from flows.logs import opened_log
from flows.pipeline import BY_NAME, weights_digest, weights_file
from flows.produce import Job
from genre_tasks.effects.applied import applied
from genre_tasks.effects.plan import effect_of
from genre_tasks.effects.types import EffectsPlan, Fitted
from genre_tasks.logs.types import Truth
from genre_tasks.metrics.collect import true_pixels, view_image
from genre_tasks.metrics.image import psnr
from genre_tasks.render.api import render_views
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.depth import lidar_depth
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel import novel_view_poses
from genre_tasks.stages.evaluate import as_recorded

CELL_S = 120.0
SIDE_M = 3.0
STAGES = ("ingest", "effects", "initial", "gnet")


@dataclass(frozen=True)
class Case:
    """How a street calls for an effect: its query, given how far beyond the threshold (a factor) its property shall be.

    ``plain``: the query of a street that does not. ``measure``: what is judged, and in ``unit``; more is better.
    """

    calls: Callable[[float], str]
    measure: Callable[[Chunk, SceneGraph, Truth | None], float]
    unit: str = "dB"
    plain: str = ""


def heldout_psnr(chunk: Chunk, scene: SceneGraph, _: Truth | None) -> float:
    """Mean over held-out views, as the cameras recorded them, outside of the vehicle itself, dB.

    Where the vehicle is in a camera's images, of such cameras alone.
    """
    masked = {v.camera for v in chunk.views if v.own is not None}
    out = []
    for view in (v for v in chunk.of_role("heldout") if not masked or v.camera in masked):
        with torch.no_grad():
            image = as_recorded(render_views(scene, [view]).color, [view]).clamp(0, 1)[0]
        out.append(psnr(image.numpy(), view_image(view).numpy(), None if view.own is None else ~view.own))
    return float(np.mean(out))


def heldout_depth(chunk: Chunk, scene: SceneGraph, _: Truth | None) -> float:
    """Minus the median relative error of depth in per cent, against the LiDAR returns of held-out frames."""
    errors = []
    for view in chunk.of_role("heldout"):
        with torch.no_grad():
            depth = render_views(scene, [view]).expected_depth()[0]
        true = lidar_depth(chunk, view)
        known = (true > 0) & (depth > 0)
        errors.append((depth[known] / true[known] - 1).abs())
    return -100 * float(torch.cat(errors).median())


def beside_psnr(chunk: Chunk, scene: SceneGraph, truth: Truth | None) -> float:
    """Mean at ±3 m against what an ideal camera would have seen, dB; held-out frames where there is no truth."""
    if truth is None:
        return heldout_psnr(chunk, scene, truth)
    views = novel_view_poses(chunk, (SIDE_M, -SIDE_M))
    out = []
    for view in views:
        with torch.no_grad():
            image = render_views(scene, [view]).color.clamp(0, 1)[0]
        out.append(psnr(image.numpy(), true_pixels(chunk, truth, view).astype(np.float32) / np.float32(255)))
    return float(np.mean(out))


def _per_cent(name: str) -> float:
    return effect_of(name).threshold / 100


PX_PER_S, PX_PER_K1 = 340.0, 265.0
"""About what a street's displacement is for a second of readout, and a pixel's shift for a k1 of 1."""

LITTLE = 0.25
"""Of the threshold: a street that does not call for what cannot be set on where the log states nothing of it."""


def _readout(factor: float) -> str:
    return f"&rolling_shutter_s={factor * effect_of('rolling_shutter').threshold / PX_PER_S:.4g}"


def _bent(factor: float) -> str:
    return f"&distortion={factor * effect_of('lens_distortion').threshold / PX_PER_K1:.4g}"


CASES: dict[str, Case] = {
    "rigid_actors": Case(lambda _: "", heldout_psnr, plain="&moving=0&pedestrians=0"),
    "rolling_shutter": Case(_readout, beside_psnr, plain=_readout(LITTLE)),
    "lens_distortion": Case(_bent, heldout_psnr, plain=_bent(LITTLE)),
    "exposure": Case(lambda x: f"&exposure_jitter={x * _per_cent('exposure'):.4g}", heldout_psnr),
    "lidar_depth": Case(lambda _: "", heldout_depth, "%", plain="&lidar_beams=1&lidar_azimuths=90"),
    "ego_mask": Case(lambda x: f"&bonnet={x * _per_cent('ego_mask'):.4g}", heldout_psnr),
}
"""Those that are modelled and that a street can be made to call for or not. Every street has a sky: there is none that
does not call for the distant region. Rolling shutter is judged beside the path: held-out frames are sheared as source
frames are, and a scene that is sheared too fits them."""


def measure(name: str, log: str, chunk: int, store: str, factor: float) -> Row:
    """The effect on and off, all others as the plan has them: its measure, PSNR at 3 m, seconds of plan and GNet."""
    reader, _, path = log.partition(":")
    if reader == "pandaset" and not Path(path).is_dir():
        raise NotMeasuredError(f"there is no folder {path}; give it with --set pandaset=PATH")
    with threads():
        auto = _plan(log, chunk, store)[name]
        out: Row = {"effect": name, "log": log, "chunk": chunk, "factor": factor, "unit": CASES[name].unit}
        out |= {"value": None if np.isnan(auto.value) else auto.value, "threshold": auto.threshold}
        out |= {"property_unit": auto.unit, "choice": auto.choice}
        on = _plan(log, chunk, store, f"effects.{name}=on")
        for word in ("on", "off"):
            out[word] = _with(name, log, chunk, store, word, on.fitted)
    return out


def _job(log: str, chunk: int, store: str, *settings: str) -> Job:
    return Job(log, chunk, store, load_configuration("small", settings=settings).model_dump(mode="json"))


def _plan(log: str, chunk: int, store: str, *settings: str) -> EffectsPlan:
    job = _job(log, chunk, store, *settings)
    found: EffectsPlan = value_of(job, reconstruct(job, STAGES[:2])["effects"])
    return found


def _with(name: str, log: str, chunk: int, store: str, word: str, on: Fitted) -> Row:
    job = _job(log, chunk, store, f"effects.{name}={word}")
    refs = reconstruct(job, STAGES)
    read, plan, scene = (value_of(job, refs[k]) for k in ("ingest", "effects", "gnet"))
    # The vehicle itself is left out of the judgement of both.
    judged = replace(plan, fitted=replace(plan.fitted, own=on.own))
    shown = applied(read, judged)
    truth = opened_log(log).truth
    return {
        "measure": CASES[name].measure(shown, scene.scene, truth),
        "heldout_db": heldout_psnr(shown, scene.scene, truth),
        "beside_db": None if truth is None else beside_psnr(shown, scene.scene, truth),
        "gnet_s": seconds_of(job, refs["gnet"])[0],
        "plan_s": seconds_of(job, refs["effects"])[0],
    }


class Effects:
    """A cell for each effect and log: streets that call for it, streets that do not, and the real chunks."""

    name = "effects"
    options: Mapping[str, str] = {
        "seeds": "1001,1002,1003", "effects": ",".join(CASES), "factors": "0,4", "store": "genre-store",
        "pandaset": "../shared/data/pandaset/002", "chunks": "0,1",
    }  # fmt: skip
    code: tuple[str, ...] = (
        "benchmarks.effects", "genre_tasks.optimiser.run", "genre_tasks.stages.ingest", "genre_tasks.stages.initial",
        "genre_tasks.stages.effects", *BY_NAME["effects"].lazy, "genre_tasks.logs.pandaset",
        "genre_tasks.logs.synthetic",
    )  # fmt: skip

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Factor 0 is the street that does not call for it. ``quick``: one street, no real log."""
        seeds = [s for s in options["seeds"].split(",") if s]
        names, chunks = ([n for n in options[k].split(",") if n] for k in ("effects", "chunks"))
        factors = [float(f) for f in options["factors"].split(",") if f]
        small = load_configuration("small")
        parameters = {
            "configuration": small.model_dump(mode="json"),
            "weights": weights_digest(weights_file(BY_NAME["gnet"], small)),
        }
        out = []
        for name in names:
            for seed in seeds[:1] if quick else seeds:
                for factor in factors:
                    log = f"synthetic:street?seed={seed}{CASES[name].calls(factor) if factor else CASES[name].plain}"
                    run = partial(measure, name, log, 0, options["store"], factor)
                    out.append(Cell(f"{name} {log}", CELL_S, run, parameters))
            for chunk in chunks if options["pandaset"] and not quick else ():
                log = f"pandaset:{options['pandaset']}"
                run = partial(measure, name, log, int(chunk), options["store"], -1.0)
                out.append(Cell(f"{name} {log} chunk {chunk}", CELL_S, run, parameters))
        return out

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """For each effect: what enabling gains at four times its threshold, and loses left out of a plain street."""
        found = [r for r in rows.values() if "not_measured" not in r]
        for name, case in CASES.items():
            kinds: tuple[tuple[float, str, Op], ...] = ((4.0, "gain", ">="), (0.0, "loss", "<"))
            for factor, claim, op in kinds:
                own = [r for r in found if r["effect"] == name and r["factor"] == factor]
                gains = [_gain(r) for r in own]
                target = (0.5 if factor else 0.1) if case.unit == "dB" else (20.0 if factor else 2.0)
                data = f"on less off; {', '.join(r['log'] for r in own) or 'not measured'}"
                yield over_cells(f"{claim}_{name}", gains, op, target, case.unit, data, bench=self.name)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """A line for each cell."""
        views, took = "held out: with | without | at 3 m: with | without", "GNet, s: with | without"
        yield f"| effect | log | measured | plan | with | without | gain | {views} | {took} |"
        yield "|---|---|---|---|---|---|---|---|---|---|---|---|---|"
        for r in (r for r in rows.values() if "not_measured" not in r):
            value = "" if r["value"] is None else f"{r['value']:.3g} {r['property_unit']} (> {r['threshold']:g})"
            views = " | ".join(_db(r[word][k]) for k in ("heldout_db", "beside_db") for word in ("on", "off"))
            log = f"{r['log'].rpartition('/')[2].removeprefix('synthetic:')} chunk {r['chunk']}"
            measured = f"{abs(r['on']['measure']):.2f} | {abs(r['off']['measure']):.2f} | {_gain(r):+.2f} {r['unit']}"
            took = f"{r['on']['gnet_s']:.2f} | {r['off']['gnet_s']:.2f}"
            yield f"| {r['effect']} | {log} | {value} | {r['choice']} | {measured} | {views} | {took} |"
        for name, case in CASES.items():
            own = [r for r in rows.values() if r.get("effect") == name and r["factor"] > 0 and r["value"] is not None]
            least = 0.1 if case.unit == "dB" else 2.0
            if len({r["factor"] for r in own}) > 1 and (at := calibrated(own, least)) is not None:
                yield f"\n{name}: enabling gains {least:g} {case.unit} at {at:.3g} {own[0]['property_unit']}"
        for name in (n for n, r in rows.items() if "not_measured" in r):
            yield f"\n{name}: not measured: {rows[name]['not_measured']}"


def _gain(row: Row) -> float:
    """What enabling brings: in dB, or in per cent of what is left without."""
    on, off = float(row["on"]["measure"]), float(row["off"]["measure"])
    return on - off if row["unit"] == "dB" else 100 * (on - off) / abs(off)


def _db(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def calibrated(rows: Sequence[Row], least: float) -> float | None:
    """The property's value at which the median gain is ``least``, between those measured; ``None`` outside of them."""
    by: dict[float, list[Row]] = {}
    for row in rows:
        by.setdefault(row["factor"], []).append(row)
    points = sorted(
        (float(np.median([r["value"] for r in own])), float(np.median([_gain(r) for r in own]))) for own in by.values()
    )
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        if y0 < least <= y1:
            return x0 + (x1 - x0) * (least - y0) / (y1 - y0)
    return None


EFFECTS = Effects()
