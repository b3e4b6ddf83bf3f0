"""Guards beside the truth: does a view's estimate rank it as its true PSNR does?"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.stats import spearmanr

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import THREADS
from benchmarks.common.run_stages import reconstruct
from flows.configuration import load_configuration
from flows.machine.facts import git_commit
from flows.pipeline.definition import stages_until
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import Job, read_artifact
from genre_tasks.config import RangeConfig
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.logs.types import Float64
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.metrics.scoring import truth_image
from genre_tasks.progress import silent
from genre_tasks.reliability.guards import PSNR_COEFFICIENTS, Guards
from genre_tasks.reliability.reliable_range import find_reliable_range, measure_guards
from genre_tasks.threads import torch_threads

CONFIG = RangeConfig(every=8)
LEAST_CORRELATION = 0.8


def measure_street(seed: str, stage: str, store: str, settings: Sequence[str] = ()) -> Row:
    """Measures guards and true PSNR of every view of the reliable range on a street.

    Args:
        seed: of the street, with further parameters of its URI if need be.
        stage: ``gnet`` or ``enet``, whose scene is rendered.
        store: folder of the store.
        settings: ``section.key=value`` over the preset ``small``.

    Returns:
        A row: ``views``, each with the fields of its guards and its ``psnr`` in dB.
    """
    log = f"synthetic:street?seed={seed}"
    config = load_configuration("small", settings=settings)
    job = Job(log, 0, store, config.model_dump(mode="json"))
    truth = cached_log(log).truth
    assert truth is not None  # every street has one
    views: list[Row] = []
    with torch_threads(THREADS):
        refs = reconstruct(job, stages_until(stage))
        chunk = apply_plan(read_artifact(job, refs["ingest"]), read_artifact(job, refs["effects"]))
        scene = read_artifact(job, refs[stage]).scene
        for novel, guards in measure_guards(CONFIG, chunk, scene, silent):
            for i, (view, guard) in enumerate(zip(novel.views, guards, strict=True)):
                true = (truth_image(chunk, truth, view) / np.float32(255)).astype(np.float32)
                image = novel.color[i].clamp(0, 1).numpy()
                views.append({"psnr": psnr(image, true), **vars(guard)})
    return {"log": log, "stage": stage, "views": views, "commit": git_commit()}


def reliability_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims how well estimates rank views, over all views of all streets, and on the worst street.

    Args:
        rows: see :func:`measure_street`.
    """
    for stage in ("gnet", "enet"):
        of_stage = [r for r in rows if r["stage"] == stage]
        views = [v for r in of_stage for v in r["views"]]
        correlation = rank_correlation(views) if views else None
        note = f"rank correlation of estimate and true PSNR over the views beside the path; {_list_streets(of_stage)}"
        name = "evaluation.reliability" if stage == "enet" else f"evaluation.reliability_{stage}"
        count = len(_select_shifted(views))
        yield claim(name, correlation, ">=", LEAST_CORRELATION, "rank correlation", note, count)
    worst = min((rank_correlation(r["views"]) for r in rows), default=None)
    note = f"the worst street; {_list_streets(rows)}"
    yield claim(
        "evaluation.reliability_worst", worst, ">=", LEAST_CORRELATION, "rank correlation", data=note, n=len(rows)
    )


def _list_streets(rows: Sequence[Row]) -> str:
    return ", ".join(f"{r['log']} {r['stage']}" for r in rows) or "not measured"


def rank_correlation(views: Sequence[Row]) -> float:
    """Correlates estimate and true PSNR of views beside the path by their ranks.

    Args:
        views: of a row.

    Returns:
        Spearman's coefficient.
    """
    estimates, truths = _estimates_and_truths(views)
    # Ranks, because the estimate need not be in decibels to order views well.
    return float(spearmanr(estimates, truths).statistic)


def _estimates_and_truths(views: Sequence[Row]) -> tuple[list[float], list[float]]:
    """Gives both in dB for the views beside the path."""
    shifted = _select_shifted(views)
    return [_guards_of(v).estimate_db for v in shifted], [v["psnr"] for v in shifted]


def _select_shifted(views: Sequence[Row]) -> list[Row]:
    # Views on the path are good everywhere, so they would raise the correlation without any merit.
    return [v for v in views if v["shift_m"]]


def _guards_of(view: Row) -> Guards:
    return Guards(**{f.name: view[f.name] for f in fields(Guards) if f.name in view})


@dataclass(frozen=True)
class EstimateFit:
    """A fit of the estimate's coefficients.

    Attributes:
        coefficients: as ``PSNR_COEFFICIENTS``.
        rank_correlation: of the views of each log beside the path, estimated by the fit of the other logs; NaN for
            fewer than two logs.
    """

    coefficients: dict[str, float]
    rank_correlation: float


def fit_estimate(rows: Sequence[Row]) -> EstimateFit:
    """Fits true PSNR to the guards of ``PSNR_COEFFICIENTS`` by least squares.

    Args:
        rows: see :func:`measure_street`. Views on the path are fitted too, as a reliable range ends where the estimate
            has fallen from there.

    Returns:
        The fit over all views, and how well it carries over to a log that it was not made on.
    """
    pairs = [(r["log"], v) for r in rows for v in r["views"]]
    logs = np.array([log for log, _ in pairs])
    guards = np.array([[1.0, v["agreement_db"], v["shown"], abs(v["shift_m"])] for _, v in pairs])
    true_db = np.array([v["psnr"] for _, v in pairs])
    coefficients = dict(zip(PSNR_COEFFICIENTS, map(float, _least_squares(guards, true_db)), strict=True))
    # With one log nothing is left to fit on.
    if len(set(logs)) < 2:
        return EstimateFit(coefficients, math.nan)
    estimates = np.empty_like(true_db)
    for log in set(logs):
        # Whole logs are left out: views of one street resemble each other too much to test a fit.
        held_out = logs == log
        estimates[held_out] = guards[held_out] @ _least_squares(guards[~held_out], true_db[~held_out])
    shifted = guards[:, 3] > 0
    return EstimateFit(coefficients, float(spearmanr(estimates[shifted], true_db[shifted]).statistic))


def _least_squares(x: Float64, y: Float64) -> Float64:
    return np.asarray(np.linalg.lstsq(x, y, rcond=None)[0], np.float64)


def true_reach_m(views: Sequence[Row], side: int) -> float:
    """Finds how far the true PSNR stays near that on the path.

    Args:
        views: of a row.
        side: 1 for the left, -1 for the right.

    Returns:
        Metres up to which the median view's PSNR is within ``CONFIG.max_drop_db`` of the path's, interpolated between
        shifts.
    """
    by_shift: dict[float, list[float]] = {}
    for v in views:
        # Shift 0 belongs to both sides, as the reference of each.
        if side * v["shift_m"] >= 0:
            by_shift.setdefault(abs(v["shift_m"]), []).append(v["psnr"])
    # The median view, because a single one may look at a wall.
    drops_db = [(shift, np.median(by_shift[0.0]) - np.median(by_shift[shift])) for shift in sorted(by_shift)]
    for (near, before), (far, after) in itertools.pairwise(drops_db):
        # The first crossing counts, even where the PSNR recovers farther out.
        if after > CONFIG.max_drop_db:
            return near + (far - near) * float((CONFIG.max_drop_db - before) / (after - before))
    return drops_db[-1][0]


def reliability_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each street and scene, and the coefficients that a fit on these rows would have.

    Args:
        rows: see :func:`measure_street`.
    """
    yield "| log | scene | views | rank correlation | mean error, dB | usable (left / right) | in truth |"
    yield "|---|---|---|---|---|---|---|"
    for r in rows:
        estimates, truths = _estimates_and_truths(r["views"])
        error = np.mean(np.abs(np.subtract(estimates, truths)))
        estimated = find_reliable_range([_guards_of(v) for v in r["views"]], CONFIG)
        columns = (
            r["log"].partition("?")[2],
            r["stage"],
            f"{len(truths)}",
            f"{rank_correlation(r['views']):.3f}",
            f"{error:.2f}",
            f"{estimated.left_m:.1f} m / {estimated.right_m:.1f} m",
            " / ".join(f"{true_reach_m(r['views'], side):.1f} m" for side in (1, -1)),
        )
        yield f"| {' | '.join(columns)} |"
    if rows:
        fit = fit_estimate(rows)
        numbers = ", ".join(f"{name} {value:.4g}" for name, value in fit.coefficients.items())
        left_out = f"rank correlation with one street left out: {fit.rank_correlation:.3f}"
        yield f"\nFitted on these views: {numbers}; {left_out}"
