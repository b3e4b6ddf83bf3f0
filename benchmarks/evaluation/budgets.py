"""``genre run --budget`` as a user starts it: a process of its own, an empty store, everything on the clock."""

from __future__ import annotations

import itertools
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim
from flows.budget.chooser import BORDER_S
from flows.budget.cost_table import Point, load, shipped_table
from flows.machine.facts import CHECKOUT, commit
from flows.pipeline.definition import reconstructing_until

JUDGED = ("evaluate.shifts_m=[3.0]", "evaluate.every=4", "evaluate.bootstrap=0", "evaluate.pictures=0")
"""Of the evaluation, which no budget counts, as much as the claims need; no snapshots for its curve."""

UNTOLD = ("gnet.snapshots=0", "enet.snapshots=0")
COMMAND = (sys.executable, "-P", "-c", "from flows.cli.main import main; main()")
MEASURE = "shift_3m/perceptual"
OVER, LEAST_USED = 1.15, 0.7


def run_within(seed: str, budget_s: float, table: str) -> Row:
    """One run of a street of preset ``small``: seconds used, what was chosen at each border, and its accuracy.

    ``command_s`` is the whole command's, evaluation and report included.
    """
    log = f"synthetic:street?seed={seed}"
    home = Path.cwd() / ".genre" / "prefect-budgets"
    if not home.is_dir():  # a user's first run ever makes Prefect's database: some twelve seconds
        _run("synthetic:street?seed=900&frames=8&cameras=1", home, "--preset", "demo")
    with tempfile.TemporaryDirectory() as store:
        sets = [part for setting in (*JUDGED, *UNTOLD) for part in ("--set", setting)]
        more = ["--table", table] if table else []
        began = time.perf_counter()
        out = _run(log, home, "--budget", f"{budget_s:g}s", *sets, *more, "--store", store, "--json")
        command_s = time.perf_counter() - began
    record = json.loads(out.strip().splitlines()[-1])
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
        "metrics": {n: metrics[n] for n in ("interpolation/psnr", "shift_3m/psnr", MEASURE)},
        "commit": commit(),
    }


def _run(log: str, home: Path, *arguments: str) -> str:
    """``genre run`` to its end: what it prints."""
    with tempfile.TemporaryDirectory() as store:
        own = () if "--store" in arguments else ("--store", store)
        environment = os.environ | {"PYTHONPATH": str(CHECKOUT), "PREFECT_HOME": str(home)}
        command = [*COMMAND, "run", log, *arguments, *own]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise NotMeasuredError(f"genre run ended with {done.returncode}: {done.stderr[-500:]}")
    return done.stdout


def claims_of(rows: Sequence[Row]) -> Iterator[Claim]:
    """Kept by nine of ten and never passed by more than 15 %; used where something costlier fits; worth it."""
    logs = sorted({r["log"] for r in rows})
    data = f"{len(rows)} runs, budgets {', '.join(f'{b:g}' for b in sorted({r['budget_s'] for r in rows}))} s; {logs}"
    parts = [r["used_s"] / r["budget_s"] for r in rows]
    kept = None if not rows else sum(p <= 1 for p in parts) / len(rows)
    yield claim("evaluation.budget_kept", kept, ">=", 0.9, "share of runs", data, len(rows))
    worst = max(parts, default=None)
    note = f"seconds used over the budget, the worst run; {data}"
    yield claim("evaluation.budget_overrun", worst, "<=", OVER, "ratio", note, len(rows))
    costlier = [r["used_s"] / r["budget_s"] for r in rows if left_out_s(r) <= r["budget_s"] - r["used_s"]]
    note = f"seconds used over the budget, the least of the runs that had time for a better setting; {data}"
    least = min(costlier, default=None)
    yield claim("evaluation.budget_used", least, ">=", LEAST_USED, "ratio", note, len(costlier))
    note = f"{MEASURE}: how much it rises from a budget to the next on one street, the worst; {data}"
    falls = [after - before for own in _by_log(rows) for before, after in itertools.pairwise(own)]
    yield claim("evaluation.budget_worth", max(falls, default=None), "<=", SPREAD, "distance", note, len(falls))


SPREAD = 0.01
"""Three standard deviations of the distance over seeds and runs of one setting (a sweep says 0.001 to 0.003)."""


def left_out_s(row: Row) -> float:
    """What the nearest better setting would have taken beyond what was used, at this run's own pace.

    Infinite where there is none. In hindsight: by the table's seconds of the stages after ingest, times what the run's
    took over the table's.
    """
    table = load(Path(row["table"]) if row.get("table") else shipped_table("small"), "small")
    own = next(p for p in table.points if p.name == row["choices"][-1]["point"])
    done = [s for s in row["seconds"] if s != "ingest"]
    foreseen = {s: table.cold.get(s, 0.0) + BORDER_S for s in reconstructing_until("enet")}
    pace = sum(row["seconds"][s] + BORDER_S for s in done) / sum(own.seconds.get(s, 0.0) + foreseen[s] for s in done)

    def more(point: Point) -> float:
        stages = set(point.seconds) | set(own.seconds)
        both = {s: [p.seconds[s] + foreseen[s] if s in p.seconds else 0.0 for p in (point, own)] for s in stages}
        return pace * sum(theirs - ours for s, (theirs, ours) in both.items() if s != "ingest")

    better = [more(p) for p in table.points if p.accuracy > own.accuracy]
    return min((s for s in better if s > 0), default=math.inf)


def _by_log(rows: Sequence[Row]) -> list[list[float]]:
    logs = {r["log"] for r in rows}
    own = [sorted((r for r in rows if r["log"] == log), key=lambda r: float(r["budget_s"])) for log in sorted(logs)]
    return [[float(r["metrics"][MEASURE]) for r in part] for part in own]


def table_of(rows: Sequence[Row]) -> Iterator[str]:
    """A line a run."""
    yield "| budget, s | log | used, s | part | settings | ends at | choices | held-out PSNR | perceptual at 3 m |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for r in sorted(rows, key=lambda r: (r["budget_s"], r["log"])):
        part, metrics = r["used_s"] / r["budget_s"], r["metrics"]
        names = " → ".join(c["point"] for c in r["choices"])
        values = f"{metrics['interpolation/psnr']:.2f} | {metrics[MEASURE]:.3f}"
        settings = ", ".join(r["settings"]) or "the preset"
        yield (
            f"| {r['budget_s']:g} | {r['log'].partition('?')[2]} | {r['used_s']:.1f} | {part:.2f} | {settings} | "
            f"{r['end']} | {names} | {values} |"
        )
    if rows:
        yield f"\nMedian part used: {np.median([r['used_s'] / r['budget_s'] for r in rows]):.2f}"
