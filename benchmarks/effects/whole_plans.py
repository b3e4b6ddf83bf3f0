"""Whole plans: what ``auto`` leaves of ``on`` where a street has everything, what it costs where it has nothing, and
whether the optimiser gains from training on logs that have effects."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.context import threads
from benchmarks.common.run_stages import reconstruct
from benchmarks.effects.cells import STAGES, Place, judged
from benchmarks.effects.measures import every_heldout_psnr, heldout_psnr
from flows.machine.facts import CHECKOUT, commit
from flows.training.optimiser_stages import TrainJob

EVERYTHING = (
    "&rolling_shutter_s=0.03&exposure_jitter=0.2&white_balance_jitter=0.05&bonnet=0.08&distortion=0.02"
    "&gloss=1&stride=1&pedestrians=16&pedestrians_aside_m=5.3"
)
"""All but motion blur: drawing its moments row by row takes a quarter of an hour."""

ALL = ("effects=on", "effects.motion_blur=auto")

SHAPED = "&rolling_shutter_s=0.03&exposure_jitter=0.2&white_balance_jitter=0.05&distortion=0.02"
"""What training with effects shows the optimiser, but for the bonnet."""

PLAIN = "&moving=0&pedestrians=0"
SHORT = ("gnet.iterations=4",)
"""Counting takes some fifty times as long as running."""

COUNTER = ("valgrind", "--tool=cachegrind", "--cache-sim=no", "--cachegrind-out-file=/dev/null")
COUNTED = re.compile(r"I\s+refs:\s+([\d,]+)")


def auto_vs_on(seed: str, store: str) -> Row:
    """Held-out PSNR of a street that has every effect, as planned and with all that can be set on."""
    at = Place(f"synthetic:street?seed={seed}{EVERYTHING}", 0, store)
    with threads():
        own = at.plan(*ALL).fitted
        out: Row = {"whole": "auto_vs_on", "log": at.log, "commit": commit()}
        settings = {"auto": ("effects=auto",), "on": ALL}
        return out | {word: judged(at, own, heldout_psnr, *each) for word, each in settings.items()}


def plain_cost(seed: str, store: str) -> Row:
    """Instructions of initial scene and GNet on a street without actors, as planned and with nothing but what it needs.

    Counted in a process each by Valgrind (one thread, AVX2), less those of a process that ends before the plan.
    ``planned`` is given its plan's artifact, ``planning`` makes it.
    """
    if shutil.which("valgrind") is None:
        raise NotMeasuredError("valgrind is not installed")
    at = Place(f"synthetic:street?seed={seed}{PLAIN}", 0, store)
    with threads():
        reconstruct(at.job(), STAGES[:2])
    counted = {word: _instructions(at, word) for word in ("start", "none", "planned", "planning")}
    base = counted["none"] - counted["start"]
    cost = {word: 100 * (counted[word] - counted["none"]) / base for word in ("planned", "planning")}
    return {"whole": "plain_cost", "log": at.log, "commit": commit(), "instructions": counted, "cost_percent": cost}


def trained(log: str, chunk: int, store: str, folder: str) -> Row:
    """GNet's scene as planned, by the weights that ship, and by those of ``genre train gnet --recipe effects``."""
    if not folder:
        raise NotMeasuredError("no training; run `genre train gnet --recipe effects`, give its folder: training=PATH")
    job, at = TrainJob(folder, "effects"), Place(log, chunk, store)
    with threads():
        own = at.plan().fitted
        out: Row = {"whole": "trained", "log": log, "chunk": chunk, "commit": commit()}
        out["shipped"] = judged(at, own, every_heldout_psnr)
        for stage in job.table():
            weights = f"gnet.weights={job.weights(stage.name)}"
            out[stage.name.partition("/")[2]] = judged(at, own, every_heldout_psnr, weights)
    return out


def _instructions(at: Place, word: str) -> int:
    module = (sys.executable, "-P", "-m", "benchmarks.effects.instruction_count")
    command = [*COUNTER, *module, word, at.log, str(at.chunk), at.store]
    environment = os.environ | {"PYTHONPATH": str(CHECKOUT), "PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1"}
    environment["GENRE_RENDER_ISA"] = "avx2"  # Valgrind knows no AVX-512
    done = subprocess.run(command, cwd=Path.cwd(), env=environment, capture_output=True, text=True, check=False)
    found = COUNTED.search(done.stderr)
    if done.returncode or found is None:
        raise NotMeasuredError(f"valgrind ended with {done.returncode}: {done.stderr[-500:]}")
    return int(found[1].replace(",", ""))
