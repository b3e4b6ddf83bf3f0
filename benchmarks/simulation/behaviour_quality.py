"""Table 6 as claims: methods along other behaviours, against the truth or as sets against a log's real images."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.task import require_log_folder
from benchmarks.simulation.scenes import METHOD, SimulationCase, describe_training, log_label
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.paper_tables.method_differences import MethodDifference, compare_methods, compare_on_log
from flows.paper_tables.methods import Method
from flows.paper_tables.rollouts import BEHAVIOUR_LABELS, TABLE_ROLLOUTS, TableRollout
from flows.paper_tables.simulation_scores import TRUE_VIEWS, LogMeasurement, RolloutRow, measure_rollout_scores
from flows.pipeline.definition import stages_until
from flows.pipeline.stage_runner import run_stage

COMPARED_METHODS = ("3dgs", "difix")
_METRICS = ("psnr", "perceptual", "kernel")


def list_rollouts(quick: bool) -> tuple[TableRollout, ...]:
    """Lists the rollouts of a log: all of table 6, or those from the left alone.

    Args:
        quick: whether half of them do.
    """
    return tuple(rollout for rollout in TABLE_ROLLOUTS if not quick or rollout.start_offset_m > 0)


def measure_behaviours(case: SimulationCase, rollouts: Sequence[TableRollout], true_views: int = TRUE_VIEWS) -> Row:
    """Measures all methods along the rollouts of a log.

    Args:
        case: the log.
        rollouts: what is driven.
        true_views: views of a rollout that are compared with the truth.

    Returns:
        ``rollouts``: metrics by method and rollout; on a recorded log ``differences`` of kernel distances, paired by
        frames.

    Raises:
        NotMeasuredError: the log's folder is missing.
    """
    require_log_folder(case.log)
    rows: list[RolloutRow] = []
    for key in (METHOD, *COMPARED_METHODS):
        method = BUILT_IN[key]
        rows += measure_rollout_scores(method.name, case.jobs(key), method.end, rollouts, true_views=true_views)
    out: Row = {
        "log": case.log,
        "chunks": list(case.chunks),
        "rollouts": [_describe(row) for row in rows],
    }
    if case.is_real:
        found = _compare_real(case, rows)
        out["differences"] = [_describe_difference(difference) for difference in found]
    return out


def _describe(row: RolloutRow) -> dict[str, Any]:
    metrics = {name: row.metrics[name] for name in _METRICS if name in row.metrics}
    return {
        "method": row.method,
        "behaviour": row.rollout.behaviour,
        "start_offset_m": row.start_offset_m,
        "strength": row.strength,
        "poses": row.poses,
        "collisions": list(row.collisions),
        # JSON has no NaN: what was not measured is missing.
        "metrics": {name: value for name, value in metrics.items() if math.isfinite(value)},
    }


def _compare_real(case: SimulationCase, rows: Sequence[RolloutRow]) -> list[MethodDifference]:
    end = BUILT_IN[METHOD].end
    jobs = case.jobs()
    refs = []
    for job in jobs:
        found: dict[str, Any] = {}
        for stage in stages_until(end):
            found[stage] = run_stage(stage, job, found)
        refs.append(found)
    real = LogMeasurement(jobs, refs, end).read_real_images()
    return [
        difference
        for other in COMPARED_METHODS
        for difference in compare_on_log(rows, BUILT_IN[METHOD].name, BUILT_IN[other].name, real)
    ]


def _describe_difference(difference: MethodDifference) -> dict[str, Any]:
    interval = (difference.low, difference.high)
    return {
        "behaviour": difference.behaviour,
        "metric": difference.metric,
        "method": difference.method,
        "other": difference.other,
        "mean": difference.mean,
        "interval": [x if math.isfinite(x) else None for x in interval],
    }


def behaviour_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that GenRe+ is nearer to the truth, and on the real log to its images, than other methods.

    A claim is about the end of the 95 % interval that is nearest to 0, so that it holds where the interval excludes 0.
    Its data says how many rollouts overlap a road user, and that chunk 0 of the real log is training data.

    Args:
        rows: see :func:`measure_behaviours`.
    """
    streets = [row for row in rows if "differences" not in row]
    measured = [_read_rollout(row["log"], entry) for row in streets for entry in row["rollouts"]]
    logs = ", ".join(log_label(row) for row in streets) or "no street"
    for other in COMPARED_METHODS:
        found = compare_methods(measured, BUILT_IN[METHOD].name, BUILT_IN[other].name, ("psnr", "perceptual"))
        by_name = {(d.behaviour, d.metric): d for d in found}
        for behaviour in BEHAVIOUR_LABELS:
            data = logs + _describe_overlaps(streets, behaviour)
            for metric in ("psnr", "perceptual"):
                yield _claim_difference(by_name.get((behaviour, metric)), behaviour, metric, BUILT_IN[other], data)
    recorded = [row for row in rows if "differences" in row]
    real = [difference for row in recorded for difference in row["differences"]]
    where = (", ".join(log_label(row) for row in recorded) or "no real log") + describe_training(recorded)
    for other in COMPARED_METHODS:
        for behaviour in BEHAVIOUR_LABELS:
            matching = (d for d in real if d["behaviour"] == behaviour and d["other"] == BUILT_IN[other].name)
            entry = next(matching, None)
            difference = None if entry is None else _read_difference(entry)
            data = where + _describe_overlaps(recorded, behaviour)
            yield _claim_difference(difference, behaviour, "kernel", BUILT_IN[other], data)


def _claim_difference(
    difference: MethodDifference | None, behaviour: str, metric: str, other: Method, data: str
) -> Claim:
    more_is_better = metric == "psnr"
    key = next(key for key, method in BUILT_IN.items() if method is other)
    name = f"simulation.{metric}_{behaviour.replace('-', '_')}_vs_{key}"
    end = "lower" if more_is_better else "upper"
    note = f"{metric} of GenRe+ less that of {other.name}, {behaviour}: {end} end of the 95 % interval; {data}"
    bound = None
    if difference is not None:
        bound = difference.low if more_is_better else difference.high
        note += f"; mean {difference.mean:+.4g}"
    if bound is not None and not math.isfinite(bound):
        bound = None
    unit = "dB" if more_is_better else "distance"
    n = 0 if difference is None else difference.n
    return claim(name, bound, ">" if more_is_better else "<", 0.0, unit, note, n)


def count_overlaps(rows: Sequence[Row], behaviour: str) -> tuple[int, int]:
    """Counts the rollouts that overlap a road user.

    Args:
        rows: see :func:`measure_behaviours`.
        behaviour: which rollouts count.

    Returns:
        How many overlap one, and how many there are; all methods drive the same rollouts.
    """
    overlaps = {
        (row["log"], entry["start_offset_m"]): bool(entry["collisions"])
        for row in rows
        for entry in row["rollouts"]
        if entry["behaviour"] == behaviour
    }
    return sum(overlaps.values()), len(overlaps)


def _describe_overlaps(rows: Sequence[Row], behaviour: str) -> str:
    overlapping, total = count_overlaps(rows, behaviour)
    return f"; {overlapping} of {total} rollouts overlap a road user" if total else ""


def _read_rollout(log: str, entry: Mapping[str, Any]) -> RolloutRow:
    return RolloutRow(
        method=entry["method"],
        log=log,
        chunks=(),
        rollout=TableRollout(entry["behaviour"], entry["start_offset_m"]),
        start_offset_m=entry["start_offset_m"],
        strength=entry["strength"],
        poses=entry["poses"],
        metrics=entry["metrics"],
    )


def _read_difference(entry: Mapping[str, Any]) -> MethodDifference:
    low, high = (math.nan if x is None else x for x in entry["interval"])
    names = {name: entry[name] for name in ("behaviour", "metric", "method", "other", "mean")}
    return MethodDifference(**names, low=low, high=high, n=1)


def behaviour_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each log, behaviour and method: means over the rollouts of both sides.

    Args:
        rows: see :func:`measure_behaviours`.
    """
    scores = "PSNR to the truth, dB | perceptual distance | kernel distance"
    yield f"| log | behaviour | strength | overlapping a road user | method | {scores} |"
    yield "|---|---|---|---|---|---|---|---|"
    for row in rows:
        for behaviour in BEHAVIOUR_LABELS:
            overlaps = "{} of {}".format(*count_overlaps([row], behaviour))
            for key in (METHOD, *COMPARED_METHODS):
                name = BUILT_IN[key].name
                found = [e for e in row["rollouts"] if e["behaviour"] == behaviour and e["method"] == name]
                if found:
                    strengths = "/".join(sorted({f"{e['strength']:g}" for e in found}))
                    values = [_format_mean(found, m, d) for m, d in (("psnr", 2), ("perceptual", 4), ("kernel", 4))]
                    columns = (log_label(row), behaviour, strengths, overlaps, name, *values)
                    yield f"| {' | '.join(columns)} |"


def _format_mean(entries: Sequence[Mapping[str, Any]], metric: str, digits: int) -> str:
    values = [entry["metrics"][metric] for entry in entries if metric in entry["metrics"]]
    return f"{math.fsum(values) / len(values):.{digits}f}" if values else "–"
