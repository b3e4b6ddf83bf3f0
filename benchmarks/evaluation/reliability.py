"""Guards beside the truth: does a view's estimate rank it as its true PSNR does?"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import fields

import numpy as np
from scipy.stats import spearmanr

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import threads
from benchmarks.common.run_stages import reconstruct
from benchmarks.common.task import value_of
from flows.configuration import load_configuration
from flows.machine.facts import commit
from flows.pipeline.definition import reconstructing_until
from flows.pipeline.log_cache import opened_log
from flows.pipeline.stage_runner import Job
from genre_tasks.config import RangeConfig
from genre_tasks.effects.apply_plan import applied
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.metrics.scoring import true_pixels
from genre_tasks.progress import silent
from genre_tasks.reliability.guards import ESTIMATE, Guards
from genre_tasks.reliability.reliable_range import judged, measured

CONFIG = RangeConfig(every=8)


def ranked(seed: str, stage: str, store: str) -> Row:
    """Every view of the range on a street: its guards and its true PSNR. What they tell is computed from the row."""
    log = f"synthetic:street?seed={seed}"
    job = Job(log, 0, store, load_configuration("small").model_dump(mode="json"))
    with threads():
        refs = reconstruct(job, reconstructing_until(stage))
        chunk, plan, scene = (value_of(job, refs[k]) for k in ("ingest", "effects", stage))
        chunk, truth, views = applied(chunk, plan), opened_log(log).truth, list[Row]()
        assert truth is not None  # a street has one
        for novel, own in measured(CONFIG, chunk, scene.scene, silent):
            for i, (view, guard) in enumerate(zip(novel.views, own, strict=True)):
                true = (true_pixels(chunk, truth, view) / np.float32(255)).astype(np.float32)
                image = novel.color[i].clamp(0, 1).numpy()
                views.append({"psnr": psnr(image, true), **vars(guard)})
    return {"log": log, "stage": stage, "views": views, "commit": commit()}


def _guards(view: Row) -> Guards:
    return Guards(**{f.name: view[f.name] for f in fields(Guards) if f.name in view})


def _beside(views: Sequence[Row]) -> tuple[list[float], list[float]]:
    """Estimates and truths of the views beside the path, dB."""
    beside = [v for v in views if v["shift_m"]]
    return [_guards(v).estimate_db for v in beside], [v["psnr"] for v in beside]


def _rank(views: Sequence[Row]) -> float:
    return float(spearmanr(*_beside(views)).statistic)


def claims_of(rows: Sequence[Row]) -> Iterator[Claim]:
    """Over all views of all streets, and on the worst street."""
    where = ", ".join(f"{r['log']} {r['stage']}" for r in rows) or "not measured"
    for stage in ("gnet", "enet"):
        own = [r for r in rows if r["stage"] == stage]
        views = [v for r in own for v in r["views"]]
        note = f"rank correlation of estimate and true PSNR over the views beside the path; {where}"
        name = "evaluation.reliability" if stage == "enet" else f"evaluation.reliability_{stage}"
        yield claim(name, _rank(views) if own else None, ">=", 0.8, "rank correlation", note, len(views))
    worst = min((_rank(r["views"]) for r in rows), default=None)
    yield claim(
        "evaluation.reliability_worst", worst, ">=", 0.8, "rank correlation", f"the worst street; {where}", len(rows)
    )


def fitted(rows: Sequence[Row]) -> tuple[dict[str, float], float]:
    """Least squares of true PSNR on the guards of ``guards.ESTIMATE`` over all views, the path's too.

    The path's, since a range ends where the estimate has fallen from there. Also the rank correlation of what each
    log's views beside the path are told by the fit of the others (NaN for fewer than two).
    """
    logs, views = zip(*((r["log"], v) for r in rows for v in r["views"]), strict=True)
    x = np.array([[1.0, v["agreement_db"], v["shown"], abs(v["shift_m"])] for v in views])
    y, of, beside = np.array([v["psnr"] for v in views]), np.array(logs), x[:, 3] > 0
    whole = np.linalg.lstsq(x, y, rcond=None)[0]
    if len(set(logs)) < 2:
        return dict(zip(ESTIMATE, map(float, whole), strict=True)), math.nan
    told = np.empty_like(y)
    for log in set(logs):
        told[of == log] = x[of == log] @ np.linalg.lstsq(x[of != log], y[of != log], rcond=None)[0]
    return dict(zip(ESTIMATE, map(float, whole), strict=True)), float(spearmanr(told[beside], y[beside]).statistic)


def true_reach(views: Sequence[Row], side: int) -> float:
    """Metres up to which the median view's true PSNR is within ``CONFIG.max_drop_db`` of the path's; left: side 1."""
    by: dict[float, list[float]] = {}
    for v in views:
        if side * v["shift_m"] >= 0:
            by.setdefault(abs(v["shift_m"]), []).append(v["psnr"])
    lost = [(shift, np.median(by[0.0]) - np.median(by[shift])) for shift in sorted(by)]
    for (near, before), (far, after) in itertools.pairwise(lost):
        if after > CONFIG.max_drop_db:
            return near + (far - near) * float((CONFIG.max_drop_db - before) / (after - before))
    return lost[-1][0]


def table_of(rows: Sequence[Row]) -> Iterator[str]:
    """A line a street and scene."""
    yield "| log | scene | views | rank correlation | mean error, dB | usable (left / right) | in truth |"
    yield "|---|---|---|---|---|---|---|"
    for r in rows:
        estimates, truths = _beside(r["views"])
        error = np.mean(np.abs(np.subtract(estimates, truths)))
        told = judged([_guards(v) for v in r["views"]], CONFIG)
        reach = f"{told.left_m:.1f} m / {told.right_m:.1f} m"
        true = " / ".join(f"{true_reach(r['views'], side):.1f} m" for side in (1, -1))
        street = r["log"].partition("?")[2]
        yield f"| {street} | {r['stage']} | {len(truths)} | {_rank(r['views']):.3f} | {error:.2f} | {reach} | {true} |"
    if rows:
        found, apart = fitted(rows)
        numbers = ", ".join(f"{name} {value:.4g}" for name, value in found.items())
        yield f"\nFitted on these views: {numbers}; rank correlation with one street left out: {apart:.3f}"
