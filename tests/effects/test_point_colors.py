"""Gains and haze of point colours: what must not pass for them, and the same bytes at any number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from genre_tasks.effects.point_colors import estimate_gains_and_haze

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
distance_m = generator.uniform(3, 25, (30, 6000))
texture = generator.uniform(0, 0.3, (30, 6000))
found = estimate_gains_and_haze(log_color, distance_m, texture, observed, np.ones(3))
print(hashlib.sha256(found.log_gain.tobytes() + found.residual.tobytes()).hexdigest(), found.haze_per_m)
"""


def _run(threads: int) -> str:
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    environment = os.environ | dict.fromkeys(names, str(threads)) | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", PROGRAM]
    return subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_gains_do_not_depend_on_threads() -> None:
    assert _run(1) == _run(2)


def test_edges_that_brighten_from_afar_are_not_haze() -> None:
    """A vehicle drives away from a road, which stays as it is, and from leaves that the sky shines through."""
    generator = np.random.default_rng(1)
    distance_m = generator.uniform(3, 12, 600) + np.linspace(0, 10, 8)[:, None]
    leaves = np.arange(600) < 400
    color = generator.normal(-3, 0.3, (600, 3))
    light = color + np.where(leaves, 0.03 * distance_m, 0.0)[..., None] + generator.normal(0, 0.02, (8, 600, 3))
    seen = np.ones((8, 600), bool)
    texture = np.broadcast_to(np.where(leaves, 0.4, 0.03), (8, 600))

    found = estimate_gains_and_haze(light, distance_m, texture, seen, np.ones(3))
    misled = estimate_gains_and_haze(light, distance_m, np.zeros((8, 600)), seen, np.ones(3))

    assert float(np.abs(found.log_gain).max()) < 0.02
    assert float(np.abs(misled.log_gain).max()) > 0.05
