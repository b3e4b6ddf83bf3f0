"""What the kernel's guards and its determinism cost: builds without them, timed in turn with the ordinary one.

The kernel's sources have a compile-time switch for each (``ABLATIONS`` in ``genre_tasks.render.kernel.build``). Such a
build is for timing only: one draws what it should cull, the other adds up gradients in a race.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.common.bench import Row
from benchmarks.common.timing import Quartiles, ratio
from benchmarks.raster.instruction_sets import IsaProcess
from benchmarks.raster.scenes import Case
from genre_tasks.compiled.build import build
from genre_tasks.compiled.loader import candidate_instruction_sets
from genre_tasks.render.kernel.build import KERNEL

SWITCHES = {"guards": "GENRE_ABLATE_GUARDS", "determinism": "GENRE_ABLATE_DETERMINISM"}
"""What a build leaves out → the compile-time switch that does so."""

_ORDINARY = "ordinary"


def measure_ablations(case: Case, threads: int, rounds: int) -> Row:
    """Measures how much faster the kernel would be without its guards, and without its determinism.

    Args:
        case: scene to render.
        threads: of the renderer.
        rounds: how often each build is timed, in turns, so that a machine that slows down slows all of them.

    Returns:
        Milliseconds of forward + backward of each build, and the ordinary one's over each other one's: above 1 is what
        that part costs.

    Raises:
        RuntimeError: the compiler fails.
    """
    isa = candidate_instruction_sets()[0]
    seconds: dict[str, list[float]] = {name: [] for name in (_ORDINARY, *SWITCHES)}
    with ExitStack() as stack:
        # A process loads one kernel for good, so each build needs its own.
        children = {_ORDINARY: stack.enter_context(IsaProcess(isa, case.name, threads))}
        for name in SWITCHES:
            folder = Path(stack.enter_context(TemporaryDirectory()))
            build_without(name, folder, isa)
            children[name] = stack.enter_context(IsaProcess(isa, case.name, threads, folder))
        # Every second round is in reverse order, so that a steady drift of the machine cancels.
        for i in range(rounds):
            for name in list(children)[:: -1 if i % 2 else 1]:
                seconds[name].append(children[name].seconds())
    return {
        "gaussians": case.count,
        "milliseconds": {name: Quartiles.from_values(values).as_row(1e3) for name, values in seconds.items()},
        "cost": {name: ratio(seconds[_ORDINARY], seconds[name]).as_row() for name in SWITCHES},
    }


def build_without(name: str, folder: Path, isa: str) -> Path:
    """Compiles the renderer's kernel without one of its parts.

    Args:
        name: a key of ``SWITCHES``.
        folder: where the library goes; nothing else may be there, as the loader cannot tell it from an ordinary one.
        isa: instruction set to compile for.

    Returns:
        Path of the library.

    Raises:
        RuntimeError: there is no compiler, or it fails.
    """
    (library,) = build([(KERNEL, folder)], defines=(SWITCHES[name],), isas=(isa,))
    return library
