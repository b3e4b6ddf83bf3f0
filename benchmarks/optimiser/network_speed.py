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
from benchmarks.common.context import THREADS
from benchmarks.common.timing import Quartiles, time_in_turns
from benchmarks.raster.scenes import street
from flows.machine.resource_usage import measure_usage
from genre_tasks.optimiser.state import Parameterization, State
from genre_tasks.optimiser.step_rules import StepRule
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, STATIC, SceneGraph
from genre_tasks.threads import torch_threads

COUNTS = (25_000, 50_000, 100_000, 200_000, 400_000)
SHELL_M = 100.0
TOTAL = 24


def street_scene_graph(count: int) -> SceneGraph:
    """Makes the renderer's benchmark street as a scene graph without actors.

    Args:
        count: Gaussians.

    Returns:
        SceneGraph: Gaussians farther than ``SHELL_M`` are distant.
    """
    s = street(count)
    nodes = torch.where(s.means.norm(dim=1) > SHELL_M, DISTANT, STATIC)
    return SceneGraph(Gaussians(s.means, s.scales.log(), s.quats, s.opacities.logit(), s.colors), nodes, ())


def prepare_step(rule: StepRule, count: int) -> tuple[Callable[[], object], float]:
    """Prepares one evaluation of a network in the middle of an optimisation.

    Args:
        rule: the network.
        count: Gaussians.

    Returns:
        The evaluation, and the seconds that its voxels took to build, once for a scene.
    """
    parameters = Parameterization.from_scene(street_scene_graph(count))
    began = time.perf_counter()
    step = rule.prepare(parameters, torch.zeros(3))
    built = time.perf_counter() - began
    generator = torch.Generator().manual_seed(0)
    gradient = torch.randn((count, 14), generator=generator)
    residuals = torch.rand((count, 5), generator=generator) if rule.uses_image_residuals else None
    # A state of zeros would let the network see features that never occur in use.
    state = State.zeros(count, gradient).accumulate(gradient, residuals)
    return lambda: step(state, gradient, TOTAL), built


def measure_network(make: Callable[[], StepRule], counts: tuple[int, ...], rounds: int) -> Row:
    """Measures one evaluation of the network against the number of Gaussians.

    Args:
        make: makes the network.
        counts: numbers of Gaussians.
        rounds: evaluations at each count, in turns.

    Returns:
        Seconds at each count, MiB that an evaluation adds at its peak, seconds to build the voxels, and a line through
        the medians.
    """
    with torch_threads(THREADS):
        made = {n: prepare_step(make(), n) for n in counts}
        seconds = time_in_turns({str(n): action for n, (action, _) in made.items()}, rounds)
        peaks = {str(n): peak_mib(action) for n, (action, _) in made.items()}
    medians = [Quartiles.from_values(seconds[str(n)]).median for n in counts]
    # An evaluation is a fixed cost and a cost for each Gaussian; R² says how well that describes it.
    slope, start = np.polyfit(counts, medians, 1).tolist()
    rest = np.array(medians) - (slope * np.array(counts) + start)
    return {
        "seconds": {name: Quartiles.from_values(values).as_row() for name, values in seconds.items()},
        "peak_mib": peaks,
        "voxels_s": {str(n): built for n, (_, built) in made.items()},
        "fit": {"seconds": start, "us_per_gaussian": slope * 1e6, "r2": float(1 - rest.var() / np.var(medians))},
    }


def peak_mib(action: Callable[[], object]) -> float:
    """Measures by how much resident memory rises while an action runs.

    Args:
        action: to run once.

    Returns:
        MiB at the peak, at least 0.
    """
    # Garbage of earlier actions may be freed in between, and would hide the rise.
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    # glibc keeps freed memory resident and hands it out again, which would hide the rise.
    if trim is not None:
        trim(0)
    before = psutil.Process().memory_info().rss / 2**20
    with measure_usage() as usage:
        action()
    return max(usage.peak_mib - before, 0.0)
