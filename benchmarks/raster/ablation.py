"""What the kernel's guards and its determinism cost: builds that lack them, timed in turn with the ordinary one.

Such a build is for timing only: one draws what it should cull, the other adds up gradients in a race.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.common.bench import Row
from benchmarks.common.timing import Measured, ratio
from benchmarks.raster.instruction_sets import IsaProcess
from benchmarks.raster.scenes import Case
from genre_tasks.compiled.loader import candidate_isas
from genre_tasks.render.kernel.build import KERNEL

Edit = tuple[str, str, str]
"""A file of the kernel, text in it, and what stands there instead."""

WITHOUT: dict[str, tuple[Edit, ...]] = {
    "guards": (
        ("project.h", "drop(bits(finite), NON_FINITE);", ""),
        ("project.h", "drop(bits(norm2(g.quat) >= QUAT_MIN_NORM2), QUATERNION);", ""),
        ("project.h", "drop(bits((det > 0.f)", "(void)(bits((det > 0.f)"),
        ("project.h", "(abs(y) <= MAX_CENTER_PX)), DEGENERATE);", "(abs(y) <= MAX_CENTER_PX)));"),
    ),
    "determinism": (
        ("blend.h", "slot[n] = pair->slot;", "slot[n] = pair->place;"),
        ("blend.h", "stream(&slots[slot[k]], sums(", "slots[slot[k]] += (sums("),
        (
            "view.h",
            "s.slots.resize(v.pairs.n);",
            "s.slots.resize(v.input.n), std::fill(s.slots.p, s.slots.p + s.slots.n, Lanes{});",
        ),
        (
            "view.h",
            "if (v.reached[k]) total += s.slots[k], any = true;",
            "any |= v.reached[k];\n      if (any) total = s.slots[i];",
        ),
    ),
}


def measure_without(case: Case, threads: int, rounds: int) -> Row:
    """Forward + backward of the ordinary kernel over that of each build: above 1 is what the part costs.

    Raises ``ValueError`` when the kernel no longer has the text that an edit replaces.
    """
    isa = candidate_isas()[0]
    seconds: dict[str, list[float]] = {name: [] for name in ("ordinary", *WITHOUT)}
    with ExitStack() as stack:
        ordinary = stack.enter_context(IsaProcess(isa, case.name, threads))
        children = {"ordinary": ordinary}
        for name, edits in WITHOUT.items():
            folder = Path(stack.enter_context(TemporaryDirectory()))
            _build_edited(folder, edits)
            children[name] = stack.enter_context(IsaProcess(isa, case.name, threads, folder))
        for i in range(rounds):
            for name in list(children)[:: -1 if i % 2 else 1]:
                seconds[name].append(children[name].seconds())
    return {
        "gaussians": case.count,
        "milliseconds": {name: Measured.of(values).as_row(1e3) for name, values in seconds.items()},
        "cost": {name: ratio(seconds["ordinary"], seconds[name]).as_row() for name in WITHOUT},
    }


def _build_edited(folder: Path, edits: tuple[Edit, ...]) -> None:
    """A copy of the package in ``folder`` whose kernel has the edits, compiled."""
    package = KERNEL.folder.parent
    copy = folder / package.name
    shutil.copytree(package, copy, ignore=shutil.ignore_patterns("weights", "__pycache__", "*.so"))
    for name, old, new in edits:
        path = copy / "render" / name
        text = path.read_text()
        if text.count(old) != 1:
            raise ValueError(f"expected once in {name}, found {text.count(old)} times: {old}")
        path.write_text(text.replace(old, new))
    # The copy's recipe on the copy's kernel; by path, since the renderer's package imports torch.
    script = (
        "import sys, runpy; sys.path.insert(0, sys.argv[1]); from genre_tasks.compiled.build import build; "
        "k = runpy.run_path(sys.argv[1] + '/genre_tasks/render/build_kernel.py')['KERNEL']; build([(k, k.folder)])"
    )
    subprocess.run([sys.executable, "-c", script, str(folder)], check=True)
