"""Whole plans: what ``auto`` loses against ``on`` where a street has everything, what it costs where it has nothing,
and whether the optimiser gains from training on logs that have effects."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.context import THREADS
from benchmarks.common.run_stages import reconstruct
from benchmarks.common.task import require_log_folder
from benchmarks.effects.cells import STAGES, ChunkLocation, evaluate_settings
from benchmarks.effects.measures import heldout_psnr
from flows.machine.facts import CHECKOUT, git_commit
from flows.pipeline.definition import digest_weights
from flows.training.train_job import TrainJob
from genre_tasks.errors import InputError
from genre_tasks.threads import torch_threads

EVERYTHING = (
    "&rolling_shutter_s=0.03&exposure_jitter=0.2&white_balance_jitter=0.05&bonnet=0.08&distortion=0.02"
    "&gloss=1&stride=1&pedestrians=16&pedestrians_aside_m=5.3"
)
"""All but motion blur: drawing its moments row by row takes a quarter of an hour."""

ALL_ON = ("effects=on", "effects.motion_blur=auto")

TRAINED_EFFECTS = "&rolling_shutter_s=0.03&exposure_jitter=0.2&white_balance_jitter=0.05&distortion=0.02"
"""The effects that training with effects shows the optimiser, but for the bonnet."""

NO_ACTORS = "&moving=0&pedestrians=0"
COUNTED_SETTINGS = ("gnet.iterations=4",)
"""Counting takes some fifty times as long as running."""

COUNTER = ("valgrind", "--tool=cachegrind", "--cache-sim=no", "--cachegrind-out-file=/dev/null")
COUNT = re.compile(r"I\s+refs:\s+([\d,]+)")


def compare_auto_with_on(location: ChunkLocation) -> Row:
    """Measures what a street that has every effect loses by its plan.

    Args:
        location: the street; ``EVERYTHING`` is added to its URI.

    Returns:
        A row: ``auto``, as planned, and ``on``, with all that can be set on; see
        :func:`benchmarks.effects.cells.evaluate_settings`.
    """
    street = _with_query(location, EVERYTHING)
    with torch_threads(THREADS):
        parameters = street.plan(*ALL_ON).parameters
        row: Row = {"whole": "auto_vs_on", "log": street.log, "commit": git_commit()}
        row["auto"] = evaluate_settings(street, parameters, heldout_psnr, "effects=auto")
        row["on"] = evaluate_settings(street, parameters, heldout_psnr, *ALL_ON)
    return row


def count_plain_cost(location: ChunkLocation) -> Row:
    """Counts what a plan costs on a street without actors.

    Instructions of initial scene and GNet are counted in a process each by Valgrind (one thread, AVX2), less those of
    a process that ends before the plan.

    Args:
        location: the street; ``NO_ACTORS`` is added to its URI.

    Returns:
        A row: instructions by kind of process, and the cost in per cent of a run with nothing but what the street
        needs: ``planned`` reads its plan from the store, ``planning`` makes it.

    Raises:
        NotMeasuredError: Valgrind is not installed, or fails.
    """
    # Asked first: the stages before the count take minutes.
    if shutil.which("valgrind") is None:
        raise NotMeasuredError("valgrind is not installed")
    street = _with_query(location, NO_ACTORS)
    with torch_threads(THREADS):
        reconstruct(street.job(), STAGES[:2])
    # Instructions and not seconds: two per cent would be lost in the noise of timing.
    counted = {kind: _count_instructions(street, kind) for kind in ("start", "none", "planned", "planning")}
    # Imports and reading would dilute the cost, so they are taken off the base too.
    base = counted["none"] - counted["start"]
    cost = {kind: 100 * (counted[kind] - counted["none"]) / base for kind in ("planned", "planning")}
    return {
        "whole": "plain_cost",
        "log": street.log,
        "commit": git_commit(),
        "instructions": counted,
        "cost_percent": cost,
    }


def compare_trained(location: ChunkLocation, folder: str) -> Row:
    """Evaluates GNet's scene as planned, by the weights that ship and by weights trained with and without effects.

    Args:
        location: the chunk.
        folder: of ``genre train gnet --recipe effects``.

    Returns:
        A row: ``shipped``, ``plain`` and ``effects``, see :func:`benchmarks.effects.cells.evaluate_settings`.

    Raises:
        NotMeasuredError: there is no folder, or none of the log; or a stage is not trained to its end.
    """
    if not folder:
        # Training takes hours, so this benchmark never starts one by itself.
        raise NotMeasuredError("no training; run `genre train gnet --recipe effects`, give its folder: training=PATH")
    require_log_folder(location.log)
    job = TrainJob(folder, "effects")
    try:
        trained = {stage.name.partition("/")[2]: job.stage_weights(stage.name) for stage in job.stages()}
    except InputError as error:
        raise NotMeasuredError(str(error)) from error
    with torch_threads(THREADS):
        parameters = location.plan().parameters
        row: Row = {"whole": "trained", "log": location.log, "chunk": location.chunk, "commit": git_commit()}
        row["shipped"] = evaluate_settings(location, parameters, heldout_psnr)
        for variant, path in trained.items():
            row[variant] = evaluate_settings(location, parameters, heldout_psnr, f"gnet.weights={path}")
    return row


def describe_training(folder: str) -> dict[str, Any]:
    """Says which weights a training has made, for the cells' cache.

    Args:
        folder: of ``genre train gnet --recipe effects``; empty without one.

    Returns:
        The digest of the weights of each stage; ``null`` for a stage that is not trained to its end.
    """
    if not folder:
        return {}
    job = TrainJob(folder, "effects")
    return {stage.name: _digest_trained(job, stage.name) for stage in job.stages()}


def _digest_trained(job: TrainJob, stage: str) -> str | None:
    try:
        return digest_weights(job.stage_weights(stage))
    except InputError:
        return None


def _with_query(location: ChunkLocation, query: str) -> ChunkLocation:
    return ChunkLocation(location.log + query, location.chunk, location.store, location.settings)


def _count_instructions(location: ChunkLocation, kind: str) -> int:
    module = (sys.executable, "-P", "-m", "benchmarks.effects.instruction_count")
    place = (location.log, str(location.chunk), location.store, *location.settings)
    # Valgrind knows no AVX-512. A fixed hash seed and one thread make the count the same from run to run.
    environment = os.environ | {
        "PYTHONPATH": str(CHECKOUT),
        "PYTHONHASHSEED": "0",
        "OMP_NUM_THREADS": "1",
        "GENRE_RENDER_ISA": "avx2",
    }
    done = subprocess.run(
        [*COUNTER, *module, kind, *place],
        cwd=Path.cwd(),
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    found = COUNT.search(done.stderr)
    if done.returncode or found is None:
        raise NotMeasuredError(f"valgrind ended with {done.returncode}: {done.stderr[-500:]}")
    return int(found[1].replace(",", ""))
