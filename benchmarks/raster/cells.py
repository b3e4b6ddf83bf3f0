"""What is measured of the renderer alone, a function per kind of cell."""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.timing import Action, Quartiles, on_threads, ratio, time_in_turns
from benchmarks.raster.instruction_sets import IsaProcess
from benchmarks.raster.machine_limits import COPY_BYTES, GEMM_FLOP, copy, gemm
from benchmarks.raster.scenes import MANY, Case, Scene, forward, forward_backward, gradient_leaves, scene
from benchmarks.raster.work_count import FLOP_PER_LANE_BACKWARD, FLOP_PER_LANE_FORWARD, count_work
from genre_tasks.compiled.build import build
from genre_tasks.compiled.loader import supported_instruction_sets
from genre_tasks.render import Cameras
from genre_tasks.render.kernel.build import KERNEL

THREADS = 2
"""What every claim is made on; one thread is measured too."""
VIEWS = 32


def renderer_actions(s: Scene, threads: int) -> tuple[Action, Action]:
    """Makes the renderer's two actions.

    Args:
        s: to render.
        threads: of the renderer.

    Returns:
        Forward, and forward + backward.
    """
    # The leaves are made once: copying them is not part of a render.
    leaves = gradient_leaves(s.splats)
    return (
        on_threads(threads, lambda: forward(s, threads)),
        on_threads(threads, lambda: forward_backward(s, leaves, threads)),
    )


def milliseconds(seconds: dict[str, list[float]]) -> dict[str, Any]:
    """Converts seconds to medians and quartiles for the JSON.

    Args:
        seconds: of each action.

    Returns:
        Milliseconds of each action.
    """
    return {name: Quartiles.from_values(values).as_row(1e3) for name, values in seconds.items()}


def measure_scene(case: Case, rounds: int) -> Row:
    """Measures the renderer at one and two threads, in turn with the machine's limits.

    Args:
        case: scene to render.
        rounds: how often each action is timed.

    Returns:
        Times, the work that was done, and the fractions of the limits.
    """
    s = scene(case)
    actions: dict[str, Action] = {}
    for t in (1, THREADS):
        actions[f"forward {t}"], actions[f"forward+backward {t}"] = renderer_actions(s, t)
        # In turn with the renderer, so that a machine that slows down slows its limits too.
        actions[f"gemm {t}"] = gemm(t)
        actions[f"copy {t}"] = copy(t)
    seconds = time_in_turns(actions, rounds)
    # Counted outside of the timing, because counting renders once more.
    work = count_work(s.splats, s.cameras)
    both = seconds[f"forward+backward {THREADS}"]
    product = seconds[f"gemm {THREADS}"]
    flop = float(FLOP_PER_LANE_FORWARD + FLOP_PER_LANE_BACKWARD)
    # Idle lanes are executed too; contributing pairs alone are what a perfect culling would compute.
    executed = ratio([x / GEMM_FLOP * flop * work.lanes for x in product], both)
    useful = ratio([x / GEMM_FLOP * flop * work.contributions for x in product], both)
    return {
        "gaussians": case.count,
        "height_px": case.height_px,
        "width_px": case.width_px,
        "milliseconds": milliseconds({k: v for k, v in seconds.items() if k.startswith("forward")}),
        "gemm_gflop_s": {
            str(t): Quartiles.from_values([GEMM_FLOP / x for x in seconds[f"gemm {t}"]]).as_row(1e-9)
            for t in (1, THREADS)
        },
        "copy_gb_s": {
            str(t): Quartiles.from_values([COPY_BYTES / x for x in seconds[f"copy {t}"]]).as_row(1e-9)
            for t in (1, THREADS)
        },
        "work": {n: getattr(work, n) for n in ("drawn", "tile_pairs", "lanes", "contributions")},
        "lane_density": work.contributions / work.lanes,
        "ns_per_pair": Quartiles.from_values([x / work.contributions for x in both]).as_row(1e9),
        "gflop_s": Quartiles.from_values([flop * work.lanes / x for x in both]).as_row(1e-9),
        "gemm_share": executed.as_row(),
        "gemm_share_of_contributing": useful.as_row(),
        "two_threads_gain": ratio(seconds["forward+backward 1"], both).as_row(),
    }


def measure_views(rounds: int) -> Row:
    """Measures many views in one call against a call for each view; both with fresh gradients.

    Args:
        rounds: how often each action is timed.

    Returns:
        Times per view, and the ratio of one call to single calls.
    """
    s = scene(MANY, VIEWS)
    # Made before the clock starts: slicing cameras is no part of a render.
    singles = [renderer_actions(_view(s, v), THREADS) for v in range(VIEWS)]
    together = renderer_actions(s, THREADS)
    actions: dict[str, Action] = {
        "forward, one call": together[0],
        "forward, single calls": lambda: [one[0]() for one in singles],
        "forward+backward, one call": together[1],
        "forward+backward, single calls": lambda: [one[1]() for one in singles],
    }
    seconds = time_in_turns(actions, rounds)
    per_view = {name: [x / VIEWS for x in values] for name, values in seconds.items()}
    return {
        "gaussians": MANY.count,
        "views": VIEWS,
        "height_px": MANY.height_px,
        "width_px": MANY.width_px,
        "milliseconds_per_view": milliseconds(per_view),
        "forward_ratio": ratio(seconds["forward, one call"], seconds["forward, single calls"]).as_row(),
        "ratio": ratio(seconds["forward+backward, one call"], seconds["forward+backward, single calls"]).as_row(),
    }


def _view(s: Scene, v: int) -> Scene:
    # A slice of one keeps the dimension of views, which the renderer expects.
    c = s.cameras
    one = slice(v, v + 1)
    camera = Cameras(c.camera_SE3_chunk[one], c.focal_px[one], c.center_px[one], c.width_px, c.height_px)
    return Scene(s.splats, camera, s.v_color[one], s.v_alpha[one], s.v_depth[one])


def measure_instruction_sets(case: Case, rounds: int) -> Row:
    """Measures forward + backward of the AVX2 and the AVX-512 build in turn, a process for each.

    Args:
        case: scene to render.
        rounds: how often each build is timed.

    Returns:
        Times, and the ratio of AVX2 to AVX-512.

    Raises:
        NotMeasuredError: the machine lacks one of the two.
    """
    # An unsupported build would die by an illegal instruction, without any message.
    if missing := {"avx512", "avx2"} - set(supported_instruction_sets()):
        raise NotMeasuredError(f"this machine does not run {', '.join(sorted(missing))}")
    with ExitStack() as stack:
        children = {isa: stack.enter_context(IsaProcess(isa, case.name, THREADS)) for isa in ("avx512", "avx2")}
        seconds: dict[str, list[float]] = {isa: [] for isa in children}
        # Every second round is in reverse order, so that a steady drift of the machine cancels.
        for i in range(rounds):
            for isa in list(children)[:: -1 if i % 2 else 1]:
                seconds[isa].append(children[isa].seconds())
    return {
        "gaussians": case.count,
        "milliseconds": milliseconds(seconds),
        "ratio": ratio(seconds["avx2"], seconds["avx512"]).as_row(),
    }


def measure_build(rounds: int) -> Row:
    """Measures how long it takes to compile the kernel for all instruction sets.

    Args:
        rounds: how often it is compiled.

    Returns:
        Names of the libraries, and seconds.
    """
    seconds = []
    libraries: list[str] = []
    for _ in range(rounds):
        # An empty folder: a library that is there already would not be compiled again.
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            libraries = [path.name for path in build([(KERNEL, Path(folder))])]
            seconds.append(time.perf_counter() - start)
    return {"libraries": libraries, "seconds": Quartiles.from_values(seconds).as_row()}
