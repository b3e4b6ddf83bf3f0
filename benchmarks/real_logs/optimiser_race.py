"""GNet against tuned Adam on real logs, with the effects that their plans call for, as a run has them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim
from benchmarks.common.context import THREADS
from benchmarks.common.over_cells import claim_over_cells
from benchmarks.common.task import load_planned_task, require_log_folder
from benchmarks.optimiser.cells import race_row, variants
from benchmarks.optimiser.claims import gain_at_equal_renders, time_ratio_to_gnet
from benchmarks.real_logs.measures import LogOfBench
from flows.configuration import load_configuration
from genre_tasks.config import GnetConfig
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.stages.planned_losses import drop_unplanned_losses
from genre_tasks.threads import torch_threads

METHODS = ("tuned_adam", "tuned_adam_split")
CAP = 5.0
"""A variant of tuned Adam is given up after so many times GNet's seconds."""

# By the reader of the log: what GNet is to gain at equal renders, dB.
_TARGET_GAINS_DB = {"kitti": 1.0, "pandaset": 0.6}
_TARGET_TIME_RATIO = 2.0


def measure_race(log: LogOfBench, order: int, method: str) -> Row:
    """Races GNet against every variant of tuned Adam from the same scene, with the same views and effects.

    Args:
        log: a real log.
        order: seed of the order of views.
        method: one of :data:`METHODS`.

    Returns:
        The row of the cell.

    Raises:
        NotMeasuredError: the log's folder is missing.
    """
    require_log_folder(log.uri)
    # As many threads for both sides as all benchmarks have, whatever earlier cells left behind.
    with torch_threads(THREADS):
        task = load_planned_task(log.job(()))
        gnet = load_configuration(log.preset, settings=log.settings).gnet
        # Only the loss depends on the plan: the effects themselves are in the scene and in its targets.
        configs = {name: _planned(config, task.plan) for name, config in variants(method).items()}
        row = race_row(task, _planned(gnet, task.plan), configs, order, method, CAP)
    # No page draws these curves, and they would be most of the file.
    for run in (row["gnet"], *row["variants"].values()):
        del run["curve"]
    return {"kind": "race", "log": log.name, "order": order, "threads": THREADS} | row


def describe_race(log: LogOfBench, order: int, method: str) -> Row:
    """Says what a race depends on beyond the code, for the cells' cache.

    Args:
        log: a real log.
        order: seed of the order of views.
        method: one of :data:`METHODS`.

    Returns:
        JSON values.
    """
    # Variants are in a file of configuration, and no code tells when one changes.
    configs = {name: config.model_dump(mode="json") for name, config in variants(method).items()}
    return {**log.parameters, "order": order, "method": method, "variants": configs, "cap": CAP}


def make_race_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Makes two claims for each real log: at equal renders, the median of its orders; in time, the worst order.

    Args:
        rows: of cells that were measured.

    Yields:
        Claim: a log without a race is claimed as not measured.
    """
    races = [row for row in rows if row["kind"] == "race" and row["method"] == "tuned_adam"]
    for reader, target in _TARGET_GAINS_DB.items():
        of_log = [row for row in races if row["log"].startswith(f"{reader} ")]
        data = of_log[0]["log"] if of_log else f"no race on a log of {reader}"
        gains = [gain for row in of_log if (gain := gain_at_equal_renders(row)) is not None]
        ratios = [time_ratio_to_gnet(row)[0] for row in of_log]
        yield claim_over_cells(f"{reader}_equal_renders", gains, ">=", target, "dB", data, bench="real_logs")
        # Every order has to hold, so the worst counts.
        yield claim_over_cells("race", ratios, ">=", _TARGET_TIME_RATIO, "ratio", data, min, bench="real_logs")


def format_races(rows: Sequence[Row]) -> Iterator[str]:
    """Makes the table of the races.

    Args:
        rows: that were measured.

    Yields:
        Lines of Markdown.
    """
    yield "| log | order | method | GNet, s | GNet | at equal renders | best | time over GNet's |"
    yield "|---|---|---|---|---|---|---|---|"
    for row in rows:
        if row["kind"] != "race":
            continue
        gain = gain_at_equal_renders(row)
        ratio, was_reached = time_ratio_to_gnet(row)
        best = max(variant["best_psnr"] for variant in row["variants"].values())
        cells = (
            row["log"],
            row["order"],
            row["method"],
            f"{row['gnet']['seconds']:.1f}",
            f"{row['gnet']['psnr']:.2f}",
            "–" if gain is None else f"{row['gnet']['psnr'] - gain:.2f}",
            f"{best:.2f}",
            f"{'' if was_reached else '≥ '}{ratio:.1f}",
        )
        yield f"| {' | '.join(map(str, cells))} |"


def _planned(config: GnetConfig, plan: EffectsPlan) -> GnetConfig:
    planned = drop_unplanned_losses(config, plan)
    assert isinstance(planned, GnetConfig)
    return planned
