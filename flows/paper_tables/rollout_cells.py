"""A cell of table 6: a method on all chunks of a log, measured along its rollouts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from flows.experiments.log_chunks import LogChunk
from flows.experiments.stage_prediction import find_stored_stages
from flows.experiments.stages import StageRunner, read_stage_costs, run_stages
from flows.paper_tables.columns import MeasuredCell
from flows.paper_tables.layouts import Layout
from flows.paper_tables.measure import Basis, list_stages
from flows.paper_tables.method_differences import average_by_behaviour
from flows.paper_tables.methods import Method
from flows.pipeline.stage_runner import read_artifact

if TYPE_CHECKING:
    from flows.paper_tables.simulation_scores import RolloutRow

_SECONDS_PER_ROLLOUT = 15.0
"""Measured on two cores at 320×180: 40 poses of three cameras, rendered and compared; half of it ray-casts a truth."""


def measure_rollout_cell(
    basis: Basis, layout: Layout, method: Method, places: Sequence[LogChunk], runner: StageRunner
) -> MeasuredCell:
    """Measures a method along the rollouts of a log.

    Args:
        basis: what all methods share.
        layout: the table with its rollouts.
        method: the row's method.
        places: the chunks of one log, in order.
        runner: runs one stage.

    Returns:
        The cell. Its seconds are sums over the chunks.

    Raises:
        ConfigError: the log has no room for a behaviour.
        GenreError: as the stages raise it.
    """
    # Imported here: what only predicts or prints a table should not load the renderer.
    from flows.paper_tables.simulation_scores import measure_rollout_scores

    jobs = [basis.job(layout, method, where) for where in places]
    refs = [run_stages(list_stages(layout, method), job, runner) for job in jobs]
    costs = [read_stage_costs(job, found) for job, found in zip(jobs, refs, strict=True)]
    rows = measure_rollout_scores(method.name, jobs, method.end, layout.rollouts, runner)
    scenes = [read_artifact(job, found[method.end]).scene for job, found in zip(jobs, refs, strict=True)]
    return MeasuredCell(
        method=method.name,
        log=places[0].log,
        chunk=None,
        seconds=_sum_by_stage([c.seconds for c in costs]),
        # NaN and not zero: an artifact from before CPU seconds were counted did cost some.
        cpu_seconds=_sum_by_stage([{k: math.nan if s is None else s for k, s in c.cpu_seconds.items()} for c in costs]),
        metrics=average_by_behaviour(rows),
        gaussians=sum(len(scene) for scene in scenes),
        fixed_views=sum(len(read_artifact(j, f["fnet"]).views) for j, f in zip(jobs, refs, strict=True) if "fnet" in f),
        remarks=describe_rollouts(rows),
    )


def describe_rollouts(rows: Iterable[RolloutRow]) -> tuple[str, ...]:
    """Says which rollouts are nearer or weaker than the paper's, which run into an actor, and what was not checked.

    Args:
        rows: of one log and method.

    Returns:
        A clause each, the same for every method.
    """
    remarks = []
    for row in rows:
        name = f"{row.rollout} on {row.log}"
        if row.start_offset_m != row.rollout.start_offset_m:
            remarks.append(f"{name} starts at {row.start_offset_m:+g} m, as road users are farther out")
        if row.strength < 1:
            remarks.append(f"{name} at strength {row.strength:g}, as there is no room for more")
        remarks += [f"{name}: {collision}" for collision in row.collisions]
        if not row.has_boxes:
            remarks.append(f"the boxes of {row.log} cannot be read: no path was checked against parked vehicles")
    # What holds for a log is said once.
    return tuple(dict.fromkeys(remarks))


def predict_rollouts(basis: Basis, layout: Layout, method: Method, places: Sequence[LogChunk]) -> dict[str, Any]:
    """Predicts what the rollouts of a method on a log would take; their stages are predicted elsewhere.

    Args:
        basis: what all methods share.
        layout: the table with its rollouts.
        method: the row's method.
        places: the chunks of one log, in order.

    Returns:
        A row as that of a cell: ``cell``, ``seconds`` and ``cached``.
    """
    missing = count_missing_rollouts(basis, layout, method, places)
    total = len(layout.rollouts)
    return {
        "cell": f"{method.name} · rollouts of {places[0].log}",
        "seconds": _SECONDS_PER_ROLLOUT * missing,
        "cached": f"{total - missing} of {total} rollouts",
    }


def count_missing_rollouts(basis: Basis, layout: Layout, method: Method, places: Sequence[LogChunk]) -> int:
    """Counts the rollouts that the store does not have.

    Args:
        basis: what all methods share.
        layout: the table with its rollouts.
        method: the row's method.
        places: the chunks of one log, in order.
    """
    jobs = [basis.job(layout, method, where) for where in places]
    names = list_stages(layout, method)
    refs = [find_stored_stages(job, names) for job in jobs]
    # Scores have the scenes in their key, so that without all scenes there are none.
    if any(len(found) < len(names) for found in refs):
        return len(layout.rollouts)
    from flows.paper_tables.simulation_scores import LogMeasurement

    measurement = LogMeasurement(jobs, refs, method.end)
    return sum(not measurement.is_stored(rollout) for rollout in layout.rollouts)


def _sum_by_stage(parts: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: math.fsum(part[name] for part in parts) for name in parts[0]}
