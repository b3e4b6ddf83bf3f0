"""What one evaluation of GNet's network costs, features included, against the number of Gaussians."""

from __future__ import annotations

import ctypes
import gc
import time
from collections.abc import Callable

import numpy as np
import psutil
import torch

from benchmarks.common.bench import Row
from benchmarks.common.context import threads
from benchmarks.common.timing import Measured, take_turns
from benchmarks.raster.scenes import street
from flows.pipeline.stage_runner import measured
from genre_tasks.optimiser.state import Frame, State
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, STATIC, SceneGraph

COUNTS = (25_000, 50_000, 100_000, 200_000, 400_000)
SHELL_M = 100.0
TOTAL = 24


def scene_of(count: int) -> SceneGraph:
    """The renderer's benchmark street as a scene graph without actors; what is beyond ``SHELL_M`` is distant."""
    s = street(count)
    nodes = torch.where(s.means.norm(dim=1) > SHELL_M, DISTANT, STATIC)
    return SceneGraph(Gaussians(s.means, s.scales.log(), s.quats, s.opacities.logit(), s.colors), nodes, ())


def step_of(rule: StepRule, count: int) -> tuple[Callable[[], object], float]:
    """One evaluation in the middle of the way, and the seconds that its voxels took to build, once a scene."""
    frame = Frame.of(scene_of(count))
    began = time.perf_counter()
    step = rule.start(frame, torch.zeros(3))
    built = time.perf_counter() - began
    generator = torch.Generator().manual_seed(0)
    gradient = torch.randn((count, 14), generator=generator)
    residuals = torch.rand((count, 5), generator=generator) if rule.residuals else None
    state = State.start(count, gradient).saw(gradient, residuals)
    return lambda: step(state, gradient, TOTAL), built


def measure_network(make: Callable[[], StepRule], counts: tuple[int, ...], rounds: int) -> Row:
    """Seconds at each count in turn, the memory that an evaluation adds at its peak, and a line through the medians."""
    with threads():
        made = {n: step_of(make(), n) for n in counts}
        seconds = take_turns({str(n): action for n, (action, _) in made.items()}, rounds)
        peaks = {str(n): peak_mib(action) for n, (action, _) in made.items()}
    medians = [Measured.of(seconds[str(n)]).median for n in counts]
    slope, start = np.polyfit(counts, medians, 1).tolist()
    rest = np.array(medians) - (slope * np.array(counts) + start)
    return {
        "seconds": {name: Measured.of(values).as_row() for name, values in seconds.items()},
        "peak_mib": peaks,
        "voxels_s": {str(n): built for n, (_, built) in made.items()},
        "fit": {"seconds": start, "us_per_gaussian": slope * 1e6, "r2": float(1 - rest.var() / np.var(medians))},
    }


def peak_mib(action: Callable[[], object]) -> float:
    """MiB by which resident memory rises at most while the action runs."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # glibc keeps freed memory resident, and would hand it out again unseen
        trim(0)
    before = psutil.Process().memory_info().rss / 2**20
    with measured() as usage:
        action()
    return max(usage.peak_mib - before, 0.0)
