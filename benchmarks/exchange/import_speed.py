"""How fast a PLY file of a million Gaussians is read, and how much memory that takes."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.timing import Quartiles
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.ply import PLY
from genre_tasks.exchange.types import SH_REST_COUNTS, SplatCloud
from genre_tasks.logs.types import Float32

GAUSSIANS = 1_000_000
SH_DEGREE = 3
MOST_SECONDS = 1.0
MOST_MEMORY = 1.5
"""Growth of resident memory per byte of the file."""

# In a process of its own: its peak is that of the import and of nothing else.
_READ = """
import json, sys, time
from pathlib import Path
from genre_tasks.exchange.ply import PLY

def read_kib(name):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name))

before = read_kib("VmRSS")
start, cpu = time.perf_counter(), time.process_time()
scene = PLY.read(Path(sys.argv[1]))
taken = {"seconds": time.perf_counter() - start, "cpu_s": time.process_time() - cpu}
print(json.dumps(taken | {"growth": 1024 * (read_kib("VmHWM") - before), "n": len(scene.nodes[0].cloud)}))
"""


def measure_import_speed(rounds: int, gaussians: int = GAUSSIANS) -> Row:
    """Times the import of a PLY file, each time in a new process; the file is in the system's cache.

    Args:
        rounds: how often.
        gaussians: how many of degree 3 the file has.

    Returns:
        Quartiles of seconds and of processor seconds, and the largest growth of resident memory per byte of the file.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "million.ply"
        PLY.write(path, make_resting_scene(_draw_cloud(gaussians)))
        size = path.stat().st_size
        runs = [_import_once(path) for _ in range(rounds + 1)]
    if {run["n"] for run in runs} != {gaussians}:
        raise RuntimeError(f"expected {gaussians} Gaussians, got {runs[0]['n']}")
    # The first one brings the file and the code into the system's cache.
    return {
        "gaussians": gaussians,
        "bytes": size,
        "seconds": Quartiles.from_values([run["seconds"] for run in runs[1:]]).as_row(),
        "cpu_s": Quartiles.from_values([run["cpu_s"] for run in runs[1:]]).as_row(),
        "memory": max(run["growth"] for run in runs) / size,
    }


def _import_once(path: Path) -> dict[str, float]:
    command = (sys.executable, "-c", _READ, str(path))
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout))


def _draw_cloud(count: int) -> SplatCloud:
    random = np.random.default_rng(0)

    def draw(*columns: int) -> Float32:
        return random.standard_normal((count, *columns), np.float32)

    return SplatCloud(
        means=draw(3),
        log_scales=draw(3),
        quats=draw(4),
        logit_opacities=draw(),
        sh_dc=draw(3),
        sh_rest=draw(SH_REST_COUNTS[SH_DEGREE], 3),
    )


def import_speed_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that the import is fast and takes little more than the Gaussians themselves.

    Args:
        rows: see :func:`measure_import_speed`; the last one counts.
    """
    row = rows[-1] if rows else None
    note = f"PLY of {GAUSSIANS} Gaussians of degree {SH_DEGREE}" if row is None else _describe(row)
    if row is None:
        yield claim("exchange.import_s", None, "<=", MOST_SECONDS, "s", note)
        yield claim("exchange.import_memory", None, "<=", MOST_MEMORY, "of the file", note)
        return
    seconds = row["seconds"]
    spread = (seconds["low"], seconds["high"])
    yield claim("exchange.import_s", seconds["median"], "<=", MOST_SECONDS, "s", note, int(seconds["n"]), spread)
    yield claim("exchange.import_memory", row["memory"], "<=", MOST_MEMORY, "of the file", note)


def _describe(row: Row) -> str:
    return f"PLY of {row['gaussians']} Gaussians of degree {SH_DEGREE}, {row['bytes'] / 1e6:.0f} MB"


def import_speed_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each file.

    Args:
        rows: see :func:`measure_import_speed`.
    """
    yield "| file | seconds, median | quartiles | processor seconds | growth of memory per byte of the file |"
    yield "|---|---|---|---|---|"
    for row in rows:
        seconds = row["seconds"]
        spread = f"{seconds['low']:.2f}–{seconds['high']:.2f}"
        cpu = f"{row['cpu_s']['median']:.2f}"
        yield f"| {_describe(row)} | {seconds['median']:.2f} | {spread} | {cpu} | {row['memory']:.2f} |"
