"""``genre run --budget`` as a user starts it: a process of its own, an empty store, everything on the clock.

Budgets are multiples of what the shortest setting takes here: on another machine a run of the same multiple has to make
the same choice, while a run of the same seconds does not.
"""

from __future__ import annotations

import itertools
import json
import math
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.command import run_genre
from flows.budget.chooser import STAGE_OVERHEAD_S
from flows.budget.cost_table import CostPoint, CostTable, find_shipped_table, load_cost_table
from flows.experiments.warm_up import TINY_LOG
from flows.machine.facts import git_commit
from flows.pipeline.definition import stages_until
from storage.files import digest_file

PRESET = "small"
EVALUATION_SETTINGS = (
    "evaluate.shifts_m=[3.0]",
    "evaluate.every=4",
    "evaluate.bootstrap=0",
    "evaluate.pictures=0",
    "gnet.snapshots=0",
    "enet.snapshots=0",
)
"""No more evaluation than the claims need, which no budget counts; no snapshots for its curve."""

SHORTEST_BUDGET_S = 1.0
"""No setting fits into it, so the shortest one runs."""

DISTANCE = "shift_3m/perceptual"
KEPT_SHARE = 0.9
MOST_OVERRUN = 1.15
LEAST_USED = 0.7
DISTANCE_NOISE = 0.01
"""Three standard deviations of the distance over seeds and runs of one setting (a sweep says 0.001 to 0.003)."""


def run_with_multiple(seed: str, multiple: float, table: str, settings: Sequence[str] = ()) -> Row:
    """Runs a street of the preset ``small`` within a multiple of its shortest run's seconds.

    The shortest run comes right before, as a shared machine may be a third faster or slower half an hour later.

    Args:
        seed: see :func:`run_with_budget`.
        multiple: of the shortest run's seconds.
        table: see :func:`run_with_budget`.
        settings: see :func:`run_with_budget`.

    Returns:
        A row as :func:`run_with_budget` returns it, with ``multiple`` and ``shortest_s``.

    Raises:
        NotMeasuredError: a command fails.
    """
    shortest_s = run_with_budget(seed, SHORTEST_BUDGET_S, table, settings)["used_s"]
    # A command's budget has whole tenths of seconds, as a user would write it.
    row = run_with_budget(seed, round(multiple * shortest_s, 1), table, settings)
    return row | {"multiple": multiple, "shortest_s": shortest_s}


def run_with_budget(seed: str, budget_s: float, table: str, settings: Sequence[str] = ()) -> Row:
    """Runs a street of the preset ``small`` within a budget.

    Args:
        seed: of the street, with further parameters of its URI if need be.
        budget_s: seconds.
        table: path of a sweep's table; the shipped one if empty.
        settings: ``section.key=value`` over the preset.

    Returns:
        A row: seconds used, what was chosen at each border, and the accuracy. ``command_s`` is the whole command's,
        evaluation and report included.

    Raises:
        NotMeasuredError: the command fails.
    """
    log = f"synthetic:street?seed={seed}"
    prefect_home = Path.cwd() / ".genre" / "prefect-budgets"
    # A user's first run ever makes Prefect's database, which takes some twelve seconds that are no run's.
    if not prefect_home.is_dir():
        with tempfile.TemporaryDirectory() as store:
            run_genre(TINY_LOG, prefect_home, "--preset", "demo", "--store", store)
    options = ["--preset", PRESET]
    for setting in (*EVALUATION_SETTINGS, *settings):
        options += ["--set", setting]
    if table:
        options += ["--table", table]
    with tempfile.TemporaryDirectory() as store:
        # The whole command is timed from outside, because a run cannot time its own start of Python.
        began = time.perf_counter()
        out = run_genre(log, prefect_home, "--budget", f"{budget_s:g}s", *options, "--store", store, "--json")
        command_s = time.perf_counter() - began
    # The record is the last line; warnings of libraries may come before it.
    record = json.loads(out.strip().splitlines()[-1])
    # A street has a single chunk.
    (chunk,) = record["chunks"]
    (chosen,) = record["budget"]["chunks"]
    stages = {s["stage"]: s for s in chunk["stages"]}
    metrics = stages[chosen["end"]]["metrics"]
    return {
        "log": log,
        "budget_s": budget_s,
        "used_s": record["budget"]["used_s"],
        "command_s": command_s,
        "speed": record["budget"]["speed"],
        "end": chosen["end"],
        "settings": chosen["settings"],
        "choices": chosen["choices"],
        "table": table,
        "seconds": {n: s["seconds"] for n, s in stages.items() if "/" not in n},
        "metrics": {n: metrics[n] for n in ("interpolation/psnr", "shift_3m/psnr", DISTANCE)},
        "commit": git_commit(),
    }


def digest_table(table: str) -> str | None:
    """Digests the table of costs that budgets are planned with.

    Args:
        table: path of a sweep's table; the shipped one if empty.

    Returns:
        64 hex digits; ``None`` where there is no such file, which the run itself reports.
    """
    path = _find_table(table)
    return digest_file(path) if path.is_file() else None


def _find_table(table: str) -> Path:
    return Path(table) if table else find_shipped_table(PRESET)


def budget_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that budgets are kept, not passed by much, used where something costlier fits, and worth it.

    Args:
        rows: see :func:`run_with_multiple`.
    """
    logs = sorted({r["log"] for r in rows})
    budgets = ", ".join(f"{m:g}" for m in sorted({r["multiple"] for r in rows}))
    data = f"{len(rows)} runs, budgets {budgets} × the shortest run; {logs}"
    used = [_used_part(r) for r in rows]
    kept = None if not rows else sum(part <= 1 for part in used) / len(rows)
    yield claim("evaluation.budget_kept", kept, ">=", KEPT_SHARE, "share of runs", data, len(rows))
    note = f"seconds used over the budget, the worst run; {data}"
    yield claim("evaluation.budget_overrun", max(used, default=None), "<=", MOST_OVERRUN, "ratio", note, len(rows))
    # A run that ends early is only to blame where a better setting would have fitted.
    missing_s = [seconds_to_better_setting(r) for r in rows]
    with_time_left = [
        _used_part(r)
        for r, seconds in zip(rows, missing_s, strict=True)
        if seconds is not None and seconds <= r["budget_s"] - r["used_s"]
    ]
    least = min(with_time_left, default=None)
    note = "seconds used over the budget, the least of the runs that had time for a better setting"
    if unknown := missing_s.count(None):
        note += f"; without {unknown}, whose setting the table no longer has"
    note += f"; {data}"
    yield claim("evaluation.budget_used", least, ">=", LEAST_USED, "ratio", note, len(with_time_left))
    # More time may not make a scene worse than runs of one setting differ among themselves.
    rises = [after - before for values in _distances_by_log(rows) for before, after in itertools.pairwise(values)]
    note = f"{DISTANCE}: how much it rises from a budget to the next on one street, the worst; {data}"
    worst = max(rises, default=None)
    yield claim("evaluation.budget_worth", worst, "<=", DISTANCE_NOISE, "distance", note, len(rises))


def seconds_to_better_setting(row: Row) -> float | None:
    """Estimates in hindsight what the nearest better setting would have taken beyond what was used.

    Args:
        row: see :func:`run_with_budget`.

    Returns:
        The table's seconds of the stages after ingest, times what the run's took over the table's; infinite where no
        setting is better; ``None`` where the table no longer has the setting that the run chose.
    """
    table = load_cost_table(_find_table(row.get("table", "")), PRESET)
    chosen = next((p for p in table.points if p.name == row["choices"][-1]["point"]), None)
    # A table that was swept again since the run may have other settings.
    if chosen is None:
        return None
    foreseen = _foreseen_seconds(chosen, table)
    done = [s for s in row["seconds"] if s != "ingest"]
    # A stage that the table's setting does not have still has its border and first calls.
    extra = _extra_seconds(table)
    measured_s = sum(row["seconds"][s] + STAGE_OVERHEAD_S for s in done)
    # One factor for the run, because the machine's speed differs from that of the table's.
    pace = measured_s / sum(foreseen.get(s, extra[s]) for s in done)
    costlier = []
    for point in table.points:
        if point.accuracy > chosen.accuracy:
            better = _foreseen_seconds(point, table)
            stages = (better.keys() | foreseen.keys()) - {"ingest"}
            costlier.append(pace * sum(better.get(s, 0.0) - foreseen.get(s, 0.0) for s in stages))
    # A better setting that is also quicker is no reason: the planner never passes it over for lack of time.
    return min((s for s in costlier if s > 0), default=math.inf)


def _foreseen_seconds(point: CostPoint, table: CostTable) -> dict[str, float]:
    """Gives what the stages of a setting take on the table's machine, by stage."""
    extra = _extra_seconds(table)
    return {stage: seconds + extra[stage] for stage, seconds in point.seconds.items()}


def _extra_seconds(table: CostTable) -> Mapping[str, float]:
    """Gives what each stage takes beyond its warm seconds: first calls, and what lies between stages."""
    return {s: table.first_call_s.get(s, 0.0) + STAGE_OVERHEAD_S for s in stages_until("enet")}


def _used_part(row: Row) -> float:
    return float(row["used_s"] / row["budget_s"])


def _distances_by_log(rows: Sequence[Row]) -> list[list[float]]:
    """Gives the distance of each log's runs, by ascending multiple of its shortest run."""
    out = []
    for log in sorted({r["log"] for r in rows}):
        # Only budgets of one street are compared: streets differ more than budgets do. By multiples, as the seconds of
        # the shortest run change with the machine's speed.
        runs = sorted((r for r in rows if r["log"] == log), key=lambda r: float(r["multiple"]))
        out.append([float(r["metrics"][DISTANCE]) for r in runs])
    return out


def budget_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each run, and the median part of the budgets that was used.

    Args:
        rows: see :func:`run_with_multiple`.
    """
    yield "| × | budget, s | log | used, s | part | settings | ends at | choices | held-out PSNR | perceptual at 3 m |"
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for r in sorted(rows, key=lambda r: (r["multiple"], r["log"])):
        metrics = r["metrics"]
        columns = (
            f"{r['multiple']:g}",
            f"{r['budget_s']:g}",
            r["log"].partition("?")[2],
            f"{r['used_s']:.1f}",
            f"{_used_part(r):.2f}",
            ", ".join(r["settings"]) or "the preset",
            r["end"],
            " → ".join(c["point"] for c in r["choices"]),
            f"{metrics['interpolation/psnr']:.2f}",
            f"{metrics[DISTANCE]:.3f}",
        )
        yield f"| {' | '.join(columns)} |"
    if rows:
        yield f"\nMedian part used: {np.median([_used_part(r) for r in rows]):.2f}"
