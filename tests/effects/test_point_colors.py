"""Gains and haze of point colours have the same bytes at any number of threads of any library."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
import hashlib
import numpy as np
from genre_tasks.effects.point_colors import estimate_gains_and_haze

generator = np.random.default_rng(0)
observed = generator.uniform(size=(30, 6000)) < 0.4
observed &= observed.sum(0) >= 2
log_color = generator.normal(-1, 0.5, (1, 6000, 3)) + generator.normal(0, 0.2, (30, 1, 3))
log_color = log_color + generator.normal(0, 0.05, (30, 6000, 3))
found = estimate_gains_and_haze(log_color, generator.uniform(3, 25, (30, 6000)), observed, np.ones(3))
print(hashlib.sha256(found.log_gain.tobytes() + found.residual.tobytes()).hexdigest(), found.haze_per_m)
"""


def _run(threads: int) -> str:
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    environment = os.environ | dict.fromkeys(names, str(threads)) | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", PROGRAM]
    return subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_gains_do_not_depend_on_threads() -> None:
    assert _run(1) == _run(2)
