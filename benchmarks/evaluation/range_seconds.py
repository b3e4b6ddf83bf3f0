"""Seconds of the reliable range with its default settings, on a chunk of a street."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import THREADS
from benchmarks.common.run_stages import reconstruct
from benchmarks.common.task import require_log_folder
from flows.configuration import load_configuration
from flows.machine.facts import git_commit
from flows.pipeline.definition import stages_until
from flows.pipeline.stage_runner import Job, read_artifact
from genre_tasks.config import RangeConfig
from genre_tasks.reliability.reliable_range import estimate_reliable_range
from genre_tasks.threads import torch_threads

MOST_S = 60.0


def measure_range_seconds(log: str, stage: str, store: str, settings: Sequence[str] = ()) -> Row:
    """Times what ``genre range`` computes, without the start of Python and the files that it writes.

    Args:
        log: URI; its chunk 0 is measured.
        stage: ``gnet`` or ``enet``, whose scene is rendered.
        store: folder of the store.
        settings: ``section.key=value`` over the preset ``small``.

    Returns:
        A row: ``range_s`` of a clock, ``range_cpu_s`` of all threads together, and the number of rendered views.
    """
    require_log_folder(log)
    config = load_configuration("small", settings=settings)
    job = Job(log, 0, store, config.model_dump(mode="json"))
    # As many threads as all benchmarks have, so that seconds can be compared.
    with torch_threads(THREADS):
        refs = reconstruct(job, stages_until(stage))
        chunk = read_artifact(job, refs["ingest"])
        plan = read_artifact(job, refs["effects"])
        scene = read_artifact(job, refs[stage]).scene
        # Only from here on: the scene is there when a range is asked for.
        began = time.perf_counter()
        cpu_began = time.process_time()
        found = estimate_reliable_range(RangeConfig(), chunk, scene, plan)
        seconds = time.perf_counter() - began
        cpu_seconds = time.process_time() - cpu_began
    return {
        "log": log,
        "stage": stage,
        "range_s": seconds,
        "range_cpu_s": cpu_seconds,
        "rendered_views": len(found.guards),
        "commit": git_commit(),
    }


def range_seconds_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that a reliable range takes at most a minute.

    Args:
        rows: see :func:`measure_range_seconds`.

    Yields:
        Claim: about the slowest row.
    """
    slowest = max((row["range_s"] for row in rows), default=None)
    what = ", ".join(f"{r['log']} {r['stage']}, {r['rendered_views']} views" for r in rows) or "not measured"
    yield claim("evaluation.range_s", slowest, "<=", MOST_S, "s", f"the range's default settings; {what}", len(rows))


def range_seconds_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each range that was timed.

    Args:
        rows: see :func:`measure_range_seconds`.
    """
    yield "| log | scene | views | reliable range, s | CPU, s |"
    yield "|---|---|---|---|---|"
    for r in rows:
        numbers = f"{r['rendered_views']} | {r['range_s']:.1f} | {r['range_cpu_s']:.1f}"
        yield f"| {r['log'].partition('?')[2] or r['log'].rpartition('/')[2]} | {r['stage']} | {numbers} |"
