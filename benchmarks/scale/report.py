"""The claims that the rows of the benchmark of scale make."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim

LEAST_SPEED_UP = 1.7
MOST_SHARE = 0.05
MOST_CACHED_S = 3.0
MOST_OBJECT_STORE_RATIO = 1.1
_NOT_MEASURED = "not measured"


def scale_claims(rows: Mapping[str, Row]) -> Iterator[Claim]:
    """Claims what workers, orchestration and a store on S3 cost, that a cluster loses nothing, and that no file harms.

    Args:
        rows: of the cells that were measured, by cell.

    Yields:
        Claim: each once.
    """
    throughput = rows.get("throughput")
    speed_up = None if throughput is None else throughput["ratio"]
    data = _NOT_MEASURED if throughput is None else _describe_throughput(throughput)
    yield claim("scale.two_workers", speed_up, ">=", LEAST_SPEED_UP, "ratio", data)
    orchestration = rows.get("orchestration")
    share = None if orchestration is None else orchestration["share"]
    data = _NOT_MEASURED if orchestration is None else _describe_orchestration(orchestration)
    yield claim("scale.orchestration_share", share, "<=", MOST_SHARE, "ratio", data)
    cached = rows.get("cached", {})
    data = f"of a worker's time for a log whose stages are all in the store{_describe_log(cached)}"
    yield _claim_quartiles("cached_log_s", cached.get("seconds"), MOST_CACHED_S, "s", data)
    objects = rows.get("object_store", {})
    data = f"a run on S3 over one on a local store{_describe_log(objects)}"
    yield _claim_quartiles("object_store_ratio", objects.get("ratio"), MOST_OBJECT_STORE_RATIO, "ratio", data)
    yield from _cluster_claims(rows.get("cluster"))
    fuzz = rows.get("fuzz")
    findings = None if fuzz is None else float(len(fuzz["findings"]))
    data = _NOT_MEASURED if fuzz is None else f"{fuzz['inputs']:,} damaged and harmful files of all formats"
    yield claim("scale.fuzz_findings", findings, "<=", 0.0, "inputs", data)


def sum_evaluation(stages_s: Mapping[str, float]) -> float:
    """Adds up the seconds of evaluation.

    Args:
        stages_s: seconds by stage.

    >>> sum_evaluation({"gnet": 4.0, "evaluate/gnet": 30.0, "evaluate/enet": 40.0})
    70.0
    """
    return sum(seconds for stage, seconds in stages_s.items() if stage.startswith("evaluate/"))


def _describe_throughput(row: Row) -> str:
    words = "the seconds with one worker over those with two, one thread each"
    return f"{row['logs']} logs, {words}{_describe_log(row)}"


def _describe_orchestration(row: Row) -> str:
    # The share alone would hide that most of what it is a share of may be evaluation.
    evaluation_s = sum_evaluation(row["stages_s"])
    orchestration_s = row["worker_s"] - row["compute_s"]
    words = "a worker's time without computation over the computation with evaluation, one log, one thread"
    seconds = f"{orchestration_s:.1f} s a log over {row['compute_s']:.0f} s, {evaluation_s:.0f} s of them evaluation"
    return f"{words}: {seconds}{_describe_log(row)}"


def _describe_log(row: Row) -> str:
    # Rows of earlier versions do not say it.
    return f"; {row['log']}, preset {row['preset']}" if "log" in row else ""


def _cluster_claims(row: Row | None) -> Iterator[Claim]:
    stages = {} if row is None else row["stages"]
    data = _NOT_MEASURED
    if row is not None:
        data = f"{row['logs']:,} logs on {row['workers']:,} simulated workers"
        data += f", seconds of stages times {row['seconds_scale']:g}"
    # What the workers have counted: the store refuses the second manifest of a stage that two of them computed.
    for name in ("lost", "doubled"):
        count = None if row is None else float(stages[name])
        yield claim(f"scale.cluster_{name}", count, "<=", 0.0, "stages", data)


def _claim_quartiles(name: str, measured: Row | None, most: float, unit: str, data: str) -> Claim:
    if measured is None:
        return claim(f"scale.{name}", None, "<=", most, unit, data)
    spread = (measured["low"], measured["high"])
    return claim(f"scale.{name}", measured["median"], "<=", most, unit, data, int(measured["n"]), spread)
